"""The exported judge in Python and its C give the same answers, whatever a chip is given; C reads nothing outside."""

import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from commands import refused, run
from hypothesis import given, settings
from hypothesis import strategies as st
from live_touches import gel_learner

from examples.benchmarks.chips.boards import BOARDS, missing_tools
from scroll_tactile import Kernels, Scene, Sensor, TactileLearner, sensors
from scroll_tactile.clients.firmware.c_files import flash_bytes, kept_levels, touches_to_check, write_firmware
from scroll_tactile.clients.firmware.exported_judge import MISSING_LEVEL, MOST_MATERIALS
from scroll_tactile.errors import InputError, UnknownMaterialError

COMPILER = shutil.which("cc") or shutil.which("gcc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
SANITIZED = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined", "-fno-sanitize-recover")
NAMES = ['"quoted"\\', "*/ oak /*", "naïve 0??/", "plain"]
SHORT = Sensor(name="short", channels=1, rate=100.0, low=0.0, high=1.0, unit="1", duration=0.4)  # one width of windows
RANGES = {"low": (-1.0, 0.1, 1e-30), "high": (2.0, 1e30, 3e-30)}
PAD = Sensor(name="pad", channels=3, rate=99.9, **RANGES, unit="N", duration=1.0)
KINDS = {"short": SHORT, "pad": PAD, "roboskin": sensors.ROBOSKIN}


def learned(sensor, touches=6, **how):
    scene = Scene(sensor=sensor)
    learner = TactileLearner(sensor=sensor, embedding=Kernels(dimension=200), **how)
    for number, name in enumerate(NAMES):
        for i in range(touches):
            learner.observe(name, scene.touch(scene.materials[number], i))
    return learner, scene


def compiled(folder, judge, flags=SANITIZED):
    """What was exported of a judge, with a program that judges a file of touches."""
    write_firmware(judge, folder, [])
    sources = [str(folder / name) for name in ("main.c", "touch_memory.c", "judge.c", "kernels.c")]
    subprocess.run([COMPILER, *flags, "-o", str(folder / "example"), *sources], check=True)
    return folder


def differing(folder, checked):
    """How many of the touches to be checked get other answers from the program; what it says is bounded."""
    (folder / "touches.bin").write_bytes(checked)
    said = subprocess.run(
        [folder / "example"], cwd=folder, capture_output=True, text=True, errors="replace", check=False
    )
    assert said.stderr == ""
    touches, _, differ, *_ = said.stdout.splitlines()[-1].split()
    return int(touches), int(differ)


@pytest.fixture(scope="module")
def exports(tmp_path_factory):
    made = {}
    for kind, sensor in KINDS.items():
        learner, scene = learned(sensor)
        judge = learner.exported()
        made[kind] = (compiled(tmp_path_factory.mktemp("c") / kind, judge), judge, scene, learner)
    return made


@needs_compiler
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 2**32), data=st.data())
def test_c_answers_as_python_whatever_it_is_given(exports, kind, seed, data):
    folder, judge, scene, _ = exports[kind]
    rng, channels = np.random.default_rng(seed), judge.sensor.channels
    touches = [judge.levels(scene.touch(name, 50 + i)) for name in scene.materials[:5] for i in range(2)]
    touches += [touch[: rng.integers(1, len(touch) + 1)] for touch in touches]
    for reach in (1, 40, 2048, 2**15 - 1):
        steps = data.draw(st.integers(1, 2 * judge.capacity))
        touches.append(rng.integers(-reach, reach + 1, (steps, channels)).astype(np.int16))
    touches.append(np.full((judge.capacity, channels), data.draw(st.integers(-2048, 2048)), np.int16))
    for touch in touches[::3]:
        touch[rng.random(touch.shape) < 0.2] = MISSING_LEVEL
    assert differing(folder, touches_to_check(judge, touches)) == (len(touches), 0)


@needs_compiler
def test_the_check_finds_an_answer_that_differs_in_one_bit(exports):
    folder, judge, scene, _ = exports["pad"]
    checked = bytearray(touches_to_check(judge, [judge.levels(scene.touch(scene.materials[0], 9))]))
    checked[-8] ^= 1  # the last score's lowest
    assert differing(folder, bytes(checked)) == (1, 1)


@needs_compiler
def test_a_touch_that_is_longer_than_the_memory_is_judged_by_what_fits(exports):
    folder, judge, scene, _ = exports["pad"]
    touch = judge.levels(scene.touch(scene.materials[1], 9))
    longer = np.concatenate([touch, np.zeros_like(touch)])
    assert judge.answer(longer) == judge.answer(touch) and judge.answer(touch).readings == judge.capacity
    assert differing(folder, touches_to_check(judge, [longer])) == (1, 0)


STRICT = ("-O2", "-Wall", "-Wextra", "-Wconversion", "-Werror")
CALLER = """#include <stdio.h>
#include "touch_memory.h"
int main(void)
{
    float values[TOUCH_MEMORY_CHANNELS];
    tactile_answer answer;
    touch_memory_begin();
    while (fread(values, sizeof values, 1, stdin) == 1) {
        int16_t levels[TOUCH_MEMORY_CHANNELS];
        for (int c = 0; c < TOUCH_MEMORY_CHANNELS; c++)
            levels[c] = touch_memory_level(c, values[c]);
        fwrite(levels, sizeof levels, 1, stdout);
        touch_memory_push(levels);
    }
    touch_memory_answer(&answer);
    fwrite(&answer.novelty, sizeof answer.novelty, 1, stdout);
    fwrite(answer.scores, sizeof *answer.scores, TOUCH_MEMORY_MATERIALS, stdout);
    printf("%s %g %d ", TOUCH_MEMORY_DIGEST, TOUCH_MEMORY_RATE, (int)answer.material);
    fwrite(TOUCH_MEMORY_SENSOR, sizeof TOUCH_MEMORY_SENSOR, 1, stdout);
    for (int m = 0; m < TOUCH_MEMORY_MATERIALS; m++)
        puts(touch_memory_names[m]);
}
"""
ODD = ('"quoted"\\', "*/ int x; /*", "naïve 0??/\n#error\\\r", "\u202e％d%s" + 3000 * "Ω")
C99, CPP = ("gcc", "-x", "c", "-std=c99"), ("g++", "-x", "c++", "-std=c++17")
CLANG, PP = ("clang", *C99[1:]), ("clang++", *CPP[1:])
WAYS = {"c": (C99, C99), "c from c++": (C99, CPP), "c++": (CPP, CPP), "clang": (CLANG, CLANG), "clang++": (CLANG, PP)}


@pytest.mark.parametrize("way", WAYS)
def test_c_and_cpp_take_values_in_the_sensors_unit_as_python_and_names_of_anything(exports, tmp_path, way):
    if any(shutil.which(compiler) is None for compiler, *_ in WAYS[way]):
        pytest.skip(f"{way} is not there")
    _, whole, scene, learner = exports["pad"]
    judge = replace(whole, materials=ODD, sensor=whole.sensor.model_copy(update={"name": "\0".join(ODD)}))
    low, high = judge.sensor.limits
    random, ties = np.random.default_rng(0).random((2, 4000, 3))
    span, ties = high - low, np.rint(4096 * ties) / 4096 + 1 / 8192
    values = [scene.touch(scene.materials[0], 9).readings, low + span * ties, low + span * (1.2 * random - 0.1)]
    values = np.concatenate([*values, [low, high]]).astype(np.float32)
    levels = replace(judge, capacity=len(values)).levels(values)
    answer, lost = judge.answer(levels), np.array([[np.nan, np.inf, -np.inf]], np.float32)
    write_firmware(judge, tmp_path, [])
    (tmp_path / "caller.c").write_text(CALLER)
    for name in ("main", "touch_memory", "judge", "kernels", "caller"):
        subprocess.run([*WAYS[way][name == "caller"], *STRICT, "-c", f"{name}.c"], cwd=tmp_path, check=True)
    objects = ["touch_memory.o", "judge.o", "kernels.o", "caller.o"]
    subprocess.run([WAYS[way][1][0], *objects, "-o", "caller"], cwd=tmp_path, check=True)
    given = values.tobytes() + lost.tobytes()
    came = subprocess.run([tmp_path / "caller"], input=given, capture_output=True, check=True).stdout
    expected = [np.append(levels, np.full(3, MISSING_LEVEL, np.int16)), np.array([answer.novelty, *answer.scores])]
    said = f"{learner.digest()} 99.9 {ODD.index(answer.material)} {judge.sensor.name}\0" + "\n".join((*ODD, ""))
    assert came == b"".join(part.tobytes() for part in expected) + said.encode()


@pytest.mark.parametrize("kind", ["pad", "roboskin"])
def test_it_knows_what_the_learner_knows_and_calls_the_same_touches_new(exports, kind):
    _, judge, scene, learner = exports[kind]
    own = [(i % 4, scene.touch(scene.materials[i % 4], 100 + i)) for i in range(40)]
    answers = [judge.predict(touch) for _, touch in own]
    assert sum(answer.material == NAMES[number] for (number, _), answer in zip(own, answers, strict=True)) >= 38
    assert (
        sum(learner.predict(touch).material == answer.material for (_, touch), answer in zip(own, answers, strict=True))
        >= 38
    )
    new = [scene.touch(scene.materials[4 + i % 4], 100 + i) for i in range(40)]
    found = [sum(one.predict(touch).known is False for touch in new) for one in (judge, learner)]
    assert found[0] >= found[1] - 6 >= 20
    assert sum(answer.known is False for answer in answers) <= 8
    assert all(0.25 <= answer.probability <= 1 for answer in answers)


def test_a_scene_is_judged_by_its_materials_alone_and_takes_less(exports):
    _, judge, scene, learner = exports["pad"]
    part = learner.exported(["plain", '"quoted"\\'])
    assert part.materials == ('"quoted"\\', "plain") and flash_bytes(part) < flash_bytes(judge)
    answer = part.predict(scene.touch(scene.materials[3], 9))
    assert answer.material == "plain" and len(answer.scores) == 2
    alone = learner.exported(["plain"]).predict(scene.touch(scene.materials[0], 9))
    assert alone.material == "plain" and alone.known is not True  # of one material nothing can be told apart


def test_what_is_too_short_has_no_answer(exports):
    _, judge, scene, _ = exports["pad"]
    answer = judge.answer(judge.levels(scene.touch(scene.materials[0], 9))[:1])
    assert (answer.material, answer.known, answer.scores, answer.readings) == (None, None, (), 1)


def test_order_and_batches_change_no_byte(tmp_path):
    learner, _ = learned(PAD, touches=3)
    other = TactileLearner(sensor=PAD, embedding=Kernels(dimension=200))
    scene = Scene(sensor=PAD)
    for i in (2, 0, 1):
        for number in (3, 1, 0, 2):
            other.observe(NAMES[number], scene.touch(scene.materials[number], i))
    for name, one in (("a", learner), ("b", other)):
        write_firmware(one.exported(), tmp_path / name, kept_levels(one.exported(), one.memory))
    written = [{path.name: path.read_bytes() for path in (tmp_path / name).iterdir()} for name in "ab"]
    assert written[0] == written[1] and len(written[0]["touches.bin"]) > 1000


def test_what_cannot_be_exported_is_refused(tmp_path, exports):
    _, judge, _, learner = exports["pad"]
    with pytest.raises(UnknownMaterialError, match="'silk'"):
        learner.exported(["silk"])
    with pytest.raises(InputError, match="at least one material"):
        learner.exported([])
    with pytest.raises(InputError, match="expected a scene of 1 to 64 materials; came 0"):
        TactileLearner(sensor=PAD).exported()
    with pytest.raises(InputError, match="only memories of the default embedding"):
        gel_learner().exported()
    (tmp_path / "x").touch()
    with pytest.raises(InputError, match="holds something"):
        write_firmware(judge, tmp_path, [])
    for levels in (np.zeros((5, 2), np.int16), np.zeros((5, 3)), np.zeros(3, np.int16)):
        with pytest.raises(InputError, match=r"expected levels int16 of shape \(T, 3\)"):
            judge.answer(levels)


@pytest.mark.parametrize(
    ("fields", "longest", "said", "argument"),
    [
        ({"rate": 62e3}, 0, r"46340 readings in a window.*has 46500\. Learn one reading in 2,.* rate=", "rate"),
        ({"channels": 2**14 + 1}, 0, r"16384 channels.*has 16385\. Learn fewer", "channels"),
        ({"channels": 60}, 2**26, r"35791394 readings in a touch.*has 67108864\. Learn touches cut", None),
        ({}, 2**29, r"536870911 readings in a touch.*has 536870912", None),
    ],
)
def test_what_a_chips_numbers_do_not_hold_is_refused(monkeypatch, fields, longest, said, argument):
    learner = TactileLearner(sensor=Sensor(**{**vars(SHORT), "duration": 1.0, **fields}), embedding=Kernels())
    monkeypatch.setattr(type(learner.memory.statistics), "longest", longest)
    with pytest.raises(InputError, match=said) as refusal:
        learner.exported()
    assert refusal.value.argument == argument


def test_too_many_materials_are_refused():
    learner = TactileLearner(sensor=SHORT, embedding=Kernels(dimension=64))
    rng = np.random.default_rng(0)
    for i in range(MOST_MATERIALS + 1):
        learner.observe(f"m{i}", rng.random((40, 1)))
    with pytest.raises(InputError, match="came 65"):
        learner.exported()
    assert len(learner.exported([f"m{i}" for i in range(MOST_MATERIALS)]).materials) == MOST_MATERIALS


@needs_compiler
def test_the_command_writes_what_make_checks(tmp_path):
    scene = Scene(sensor=PAD)
    with TactileLearner.open(tmp_path / "m", sensor=PAD, embedding=Kernels(dimension=100)) as learner:
        for i in range(4):
            for name in scene.materials[:3]:
                learner.observe(name, scene.touch(name, i))
    two = scene.materials[:2]
    done = run("memory", "export", tmp_path / "m", tmp_path / "c", "--format", "c", "--scene", ",".join(two))
    assert done.exit_code == 0 and "2 materials" in done.output and "12 touches" in done.output.replace("\n", " ")
    if shutil.which("make"):
        checked = subprocess.run(["make", "check"], cwd=tmp_path / "c", capture_output=True, text=True, check=True)
        assert "12 touches, 0 answers differ" in checked.stdout
    assert "--scene is for --format c" in refused("memory", "export", tmp_path / "m", tmp_path / "d", "--scene", two[0])


def test_ram_is_what_c_reserves(exports, tmp_path):
    if (sizes := shutil.which("arm-none-eabi-gcc")) is None:
        pytest.skip("arm-none-eabi-gcc is not there")
    for kind, (folder, judge, *_) in exports.items():
        source = tmp_path / f"{kind}.c"
        source.write_text('#include "judge.h"\nchar size[sizeof(tactile_touch)];\n')
        subprocess.run([sizes, "-c", f"-I{folder}", "-o", tmp_path / "o", source], check=True)
        listed = subprocess.run(["arm-none-eabi-nm", "-S", tmp_path / "o"], capture_output=True, text=True, check=True)
        fixed = int(listed.stdout.split()[1], 16)
        most = max(
            len(one.phases) if one else 0
            for one in (judge.embedding.triangles(judge.sensor.channels, each.scale.width) for each in judge.scales)
        )
        channels = judge.sensor.channels
        assert judge.ram_bytes == fixed + 2 * channels * judge.capacity + 16 * judge.capacity + 4 * most + 16 * channels


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.name)
def test_a_chip_answers_as_python(exports, tmp_path, board):
    if lacking := missing_tools(board):
        pytest.skip(f"{', '.join(lacking)} are not there")
    _, judge, scene, _ = exports["pad"]
    touches = [judge.levels(scene.touch(name, 70)) for name in scene.materials[:6]]
    write_firmware(judge, tmp_path / "c", [*touches, *(touch[:50] for touch in touches)])
    program = board.build(tmp_path / "c")
    assert board.judge(program, tmp_path / "c" / "touches.bin") == {"touches": 12, "differ": 0}
