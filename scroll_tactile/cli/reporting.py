"""`scroll-tactile report`: a memory, or a recording, as one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from scroll_tactile.cli.terminal import opened_for_upkeep, progress_bar, say, shown
from scroll_tactile.errors import InputError
from store import NotAStoreError

__all__ = ["report"]


def report(
    source: Annotated[Path, typer.Argument(help="The folder of a memory, or a recording.", show_default=False)],
    page: Annotated[Path, typer.Argument(help="The page to write, such as page.html.", show_default=False)],
    topic: Annotated[str | None, typer.Option(help="Of a recording: which topic.")] = None,
    field: Annotated[str | None, typer.Option(help="Of a recording: where its numbers are.")] = None,
    preset: Annotated[str | None, typer.Option(help="Of a recording: a known sensor, in place of both.")] = None,
    clock: Annotated[str | None, typer.Option(help="Of a recording: whose times.")] = None,
    rate: Annotated[float | None, typer.Option(help="Of a recording without times: readings a second.")] = None,
    intervals: Annotated[
        Path | None, typer.Option(help="Of a recording: a CSV of file, begin, end, material that cuts it to touches.")
    ] = None,
) -> None:
    """Write a page that shows what a memory knows, or what a recording holds; any browser opens it, without network."""
    from scroll_tactile.report.page import require_page, save

    require_page(page)
    chosen: dict[str, Any] = {"topic": topic, "field": field, "preset": preset, "clock": clock, "rate": rate}
    if _is_memory(source):
        given = [f"--{name}" for name, value in {**chosen, "intervals": intervals}.items() if value is not None]
        if given:
            raise InputError(f"{', '.join(given)}: only of a recording; {source} is a memory")
        from scroll_tactile.report.memory_page import memory_page

        with opened_for_upkeep(source, mode="read") as learner, progress_bar() as progress:
            html = memory_page(learner, progress=progress)
    else:
        from scroll_tactile.recordings import read_intervals
        from scroll_tactile.report.recording_page import recording_page

        cut = None if intervals is None else read_intervals(intervals)
        html = recording_page(source, intervals=cut, **chosen)
    save(html, page)
    say(f"written: {shown(page)}, {len(html.encode()) / 1e6:.1f} MB; open it with any browser")


def _is_memory(source: Path) -> bool:
    """Whether a memory lies there, sound or not; what holds no store may be a recording."""
    from store.layout import holds_store

    if not source.is_dir():
        return False
    try:
        return holds_store(source)
    except NotAStoreError:
        return False
