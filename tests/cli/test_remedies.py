"""What an error proposes is typed: it gives the right touches, or leads on to another error whose cure does."""

import itertools
import re

import h5py
import numpy as np
import pytest
from commands import run

from scroll_tactile import Sensor, TactileLearner

PAD = Sensor(name="pad", channels=4, rate=100.0, low=0.0, high=1023.0, unit="counts", duration=1.5)
OPTION = re.compile(r"(--[a-z-]+) '([^']+)'")
TIMES = np.arange(150)[:, None] / 100


def touch(seed, mean=400.0):
    random, times = np.random.default_rng(seed), np.arange(150)[:, None] / 100
    return np.round(mean + 200 * np.sin(9 * times + np.arange(4)) + random.normal(0, 9, (150, 4)), 1)


def table(path, rows, head=None, mark=","):
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [mark.join(f"{value:.2f}" for value in row) for row in rows]
    path.write_text("\n".join([*([head] if head else []), *lines]) + "\n")


def wide(folder):
    np.save(folder / "r.npy", np.hstack([touch(0), touch(1)[:, :2]]))


def unnamed_times(folder):
    table(folder / "r.csv", np.hstack([1.7e9 + TIMES, touch(0)]))


def stack(folder):
    np.save(folder / "r.npy", np.stack([touch(seed) for seed in range(20)]))


def several(folder):
    np.savez(folder / "r.npz", left=touch(0), right=touch(1))


def groups(folder):
    with h5py.File(folder / "r.h5", "w") as file:
        for i, name in enumerate(("felt", "oak")):
            for pose in ("Pose1", "Pose2"):
                file[f"run/{name}/{pose}/tactile"] = touch(2 * i + (pose == "Pose2"))


def slow(folder):
    table(folder / "r.csv", np.hstack([2 * TIMES, touch(0)]), "time,a,b,c,d")


def commas(folder):
    rows = [";".join(f"{value:.3f}".replace(".", ",") for value in row) for row in touch(0)]
    (folder / "r.csv").write_text("\n".join(["a;b;c;d", *rows]) + "\n")


def trials(folder):
    for name in ("felt", "oak"):
        for trial in ("1", "2"):
            table(folder / name / trial / "t.csv", touch(10 * len(name) + int(trial)))


def other_names(folder):
    for number, head in enumerate(("a,b,c,d", "w,x,y,z")):
        table(folder / f"{number}.csv", touch(number), head)


FELT = ("--label", "felt")


def of(name, *seeds):
    return [(name, touch(seed)) for seed in seeds]


@pytest.mark.parametrize(
    ("made", "words", "touches"),
    [
        (wide, FELT, of("felt", 0)),
        (unnamed_times, FELT, of("felt", 0)),
        (stack, FELT, of("felt", *range(20))),
        (several, FELT, of("felt", 0)),
        (groups, ("--label-by", "folder", "--field", "tactile"), of("felt", 0, 1) + of("oak", 2, 3)),
        (slow, FELT, of("felt", 0)),
        (commas, FELT, of("felt", 0)),
        (trials, ("--label-by", "folder"), of("felt", 41, 42) + of("oak", 31, 32)),
        (other_names, FELT, of("felt", 0, 1)),
    ],
    ids=lambda each: getattr(each, "__name__", ""),
)
def test_what_is_proposed_gives_the_right_touches(tmp_path, made, words, touches):
    sources, memory = tmp_path / "rec", tmp_path / "m"
    sources.mkdir()
    made(sources)
    (tmp_path / "pad.json").write_text(PAD.model_dump_json())
    typed, said = {**dict(zip(words[::2], words[1::2], strict=True)), "--sensor": str(tmp_path / "pad.json")}, []
    while (result := run("learn", memory, sources, *itertools.chain(*typed.items()))).exit_code:
        assert result.output not in said, result.output
        said.append(result.output)
        option, value = OPTION.search(" ".join(result.output.split())).groups()
        typed[option] = value
    assert said
    expected = TactileLearner(sensor=PAD)
    for name, readings in touches:
        expected.observe(name, readings)
    with TactileLearner.open(memory, mode="read") as learner:
        assert learner.digest() == expected.digest()


def test_a_sensor_that_is_guessed_can_be_learned_with(tmp_path):
    table(tmp_path / "r.csv", np.hstack([TIMES, touch(0)]), "time,a,b,c,d")
    without = run("learn", tmp_path / "m", tmp_path / "r.csv", *FELT)
    assert without.exit_code == 1 and "scroll-tactile sensor FILES > sensor.json" in without.output
    guessed = run("sensor", tmp_path / "r.csv")
    assert guessed.exit_code == 0
    (tmp_path / "sensor.json").write_text(guessed.stdout)
    assert run("learn", tmp_path / "m", tmp_path / "r.csv", *FELT, "--sensor", tmp_path / "sensor.json").exit_code == 0
    with TactileLearner.open(tmp_path / "m", mode="read") as learner:
        assert (learner.sensor.channels, learner.sensor.rate) == (4, 100.0)
        assert learner.materials == {"felt": 1}
