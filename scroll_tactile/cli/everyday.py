"""`scroll-tactile observe`, `predict` and `inspect`: a memory on disk, and streams in files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from scroll_tactile.cli.terminal import console, opened, opened_for_upkeep, percent, say, say_json, shown, verdict
from scroll_tactile.settings import require_name

__all__ = ["inspect", "observe", "predict"]

MemoryFolder = Annotated[Path, typer.Argument(help="The folder of the memory.", show_default=False)]
StreamFile = Annotated[
    Path, typer.Argument(help="A .npy or .csv file of readings: a row each, a column per channel.", show_default=False)
]


def observe(
    memory: MemoryFolder,
    material: Annotated[str, typer.Argument(help="What was touched; any name.", show_default=False)],
    file: StreamFile,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="Whose readings they are: biotac, biotac-all, roboskin, contactile, gelsight, or a JSON file with "
            "name, channels, rate, low, high, unit and duration. Needed only to make a new memory."
        ),
    ] = None,
) -> None:
    """Learn how a material feels, from one touch in a file; it is on disk when this returns."""
    from scroll_tactile.recordings.arrays import read_sensor, read_stream, require_readable

    require_name(material)
    readings = read_stream(file)
    chosen = None if sensor is None else read_sensor(sensor)
    if chosen is not None and not memory.exists():
        require_readable(readings, chosen)  # what is refused makes no memory
    with opened(memory, sensor=chosen) as learner:
        receipt = learner.observe(material, readings)
        count = learner.materials[material]
    clipped = f", {receipt.clipped} values outside the sensor's range clipped" if receipt.clipped else ""
    say(f"{shown(material)}: {receipt.seconds:g} s kept as observation {receipt.sequence}{clipped}")
    say(f"it has now been observed {count} time{'s' * (count > 1)}")


def predict(
    memory: MemoryFolder,
    file: StreamFile,
    scene: Annotated[
        str | None, typer.Option(help="The materials that can be here, separated by commas; all of them otherwise.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, with the whole ranking.")] = False,
) -> None:
    """Say what a touch in a file feels like; the memory stays as it is."""
    candidates = None if scene is None else [name.strip() for name in scene.split(",") if name.strip()]
    from scroll_tactile.recordings.arrays import read_stream

    readings = read_stream(file)
    with opened(memory, mode="read") as learner:
        prediction = learner.predict(readings, scene=candidates)
    if as_json:
        infinite = prediction.novelty == float("inf")  # JSON has no infinity
        answer = {
            "material": prediction.material,
            "probability": prediction.probability,
            "known": prediction.known,
            "novelty": None if infinite else prediction.novelty,
            "seconds": prediction.seconds,
            "ranking": prediction.ranking,
        }
        say_json(answer)
        return
    say(f"{verdict(prediction)}, from {prediction.seconds:g} s of touch")
    for name, probability in prediction.ranking[:5]:
        say(f"  {percent(probability):>8}  {shown(name)}")


def inspect(memory: MemoryFolder, as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Show what a memory holds: materials with their counts, sensor, embedding, digest and size on disk."""
    with opened_for_upkeep(memory, mode="read") as learner:
        materials, digest, sensor, embedding = learner.materials, learner.digest(), learner.sensor, learner.embedding
        kept = len(learner.memory.kept or ())
    size = sum(file.stat().st_size for file in memory.rglob("*") if file.is_file())
    if as_json:
        found = {
            "materials": materials,
            "observations": sum(materials.values()),
            "kept": kept,
            "sensor": sensor.model_dump(mode="json"),
            "embedding": {
                "name": embedding.name,
                "dimension": embedding.dimension,
                "fingerprint": embedding.fingerprint,
            },
            "digest": digest,
            "bytes": size,
        }
        say_json(found)
        return
    table = Table("material", "observations")
    for name, count in materials.items():
        table.add_row(shown(name), str(count))
    console().print(table)
    say(f"[bold]observations:[/] {sum(materials.values())} of {len(materials)} materials")
    say(f"[bold]kept for recall:[/] {kept} touches")
    say(f"[bold]sensor:[/] {shown(sensor.name)}, {sensor.channels} channels at {sensor.rate:g} Hz")
    say(
        f"[bold]embedding:[/] {shown(embedding.name)}, {embedding.dimension} features, "
        f"fingerprint {embedding.fingerprint[:12]}"
    )
    say(f"[bold]digest:[/] {digest}")
    say(f"[bold]on disk:[/] {size / 2**20:.1f} MB")
