"""Contact by the sensor's own noise at rest."""

import numpy as np
import pytest
from live_touches import learner, shift, slide
from touches import PAD, SMALL

from scroll_tactile import Sensor, TactileLearner, sensors
from scroll_tactile.live.detector import ContactDetector, Rest
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.simulation.shift import simulated_shift


def found(sensor, rows, false_contacts=1.0, size=10_000):
    """The contacts of a stream: (first, last) readings, and the detector."""
    detector, first, contacts, begun = ContactDetector(sensor, false_contacts), 0, [], 0
    while first < len(rows):
        used, event = detector.feed(rows[first : first + size])
        first += used
        if event is not None and event.kind == "began":
            begun = first - event.readings
        elif event is not None and event.kind != "relearned":
            contacts.append((begun, first - event.readings))
    return contacts, detector


def wide(channels, unit="N", **fields):
    return Sensor(
        **{"name": "wide", "channels": channels, "rate": 100.0, "low": -5.0, "high": 5.0, "unit": unit, "duration": 2.0}
        | fields
    )


@pytest.mark.parametrize("noise", ["white", "slow", "common", "counts", "heavy"])
def test_noise_alone_is_no_contact(noise):
    random = np.random.default_rng(3)
    rows = random.standard_normal((20_000, 12))
    if noise == "slow":
        for i in range(1, len(rows)):
            rows[i] = 0.9 * rows[i - 1] + 0.44 * rows[i]
    elif noise == "common":
        rows += 5 * random.standard_normal((len(rows), 1))
    elif noise == "counts":
        rows = np.rint(0.4 * rows) * 2.5
    elif noise == "heavy":
        rows = random.standard_t(4, rows.shape)
    contacts, _ = found(wide(12), 0.02 * rows)
    assert len(contacts) <= 1  # 200 seconds, of which an hour may have one


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_units_do_not_matter(scale):
    random = np.random.default_rng(4)
    rows = 0.02 * random.standard_normal((3000, 12))
    rows[1000:1400] += 0.3
    rows[2000:2300, 3:5] -= 0.4
    sensor = wide(12, low=-5.0 * scale, high=5.0 * scale)
    contacts, _ = found(sensor, scale * rows)
    assert np.abs(np.array(contacts) - [(1000, 1400), (2000, 2300)]).max() <= 2


def test_glitches_are_no_contact_and_drift_is_followed_and_a_touch_on_it_is_found():
    rows = 0.02 * np.random.default_rng(6).standard_normal((30_000, 12))
    drifting = rows + np.linspace(0, 3, 30_000)[:, None]
    rows[1000::300] = 5.0
    rows[1001::900] = -5.0
    assert found(wide(12), rows[:5000])[0] == []
    drifting[20_000:20_300] += 0.5
    contacts, _ = found(wide(12), drifting)
    assert len(contacts) == 1 and abs(contacts[0][0] - 20_000) <= 2


def test_a_level_that_does_not_come_back_ends_the_touch_all_the_same():
    random = np.random.default_rng(7)
    rows = 0.02 * random.standard_normal((4000, 12))
    rows[1000:1400] += 1 + 0.3 * np.sin(np.arange(400))[:, None]
    rows[1400:] += 0.03
    contacts, detector = found(wide(12), rows)
    assert len(contacts) == 1 and abs(contacts[0][1] - 1400) <= 3
    assert not detector.contact


def test_a_level_that_moved_for_good_is_rest_in_the_end():
    random = np.random.default_rng(8)
    rows = 0.02 * random.standard_normal((9000, 12))
    rows[3000:] += 1.0
    rows[7000:7200] += 1.0
    with TactileLearner(sensor=wide(12)).live() as live:
        ended = live.push(rows).touches
    assert [touch.end for touch in ended] == ["still", "released"]
    assert abs(round(ended[1].at * 100) - 7000) <= 2


def test_noise_that_grew_for_good_while_rest_was_hardly_known_is_learned_anew():
    rows = np.random.default_rng(11).standard_normal((5000, 12))
    rows[:300] *= 0.02
    rows[300:] = 1 + 0.1 * rows[300:]
    rows[4000:4300] += 2.0
    contacts, detector = found(wide(12), rows)
    assert np.abs(np.array(contacts[-1]) - [4000, 4300]).max() <= 3 and not detector.contact


def test_contact_from_the_first_reading_on_is_found_out_and_reported():
    random = np.random.default_rng(9)
    rows = np.concatenate([slide("a", 200, random), shift("ab", 2)[0]])
    with learner().live() as live:
        assert live.push(rows[:20]) == live.push([]) and live.report.learning
        ended = live.push(rows[20:]).touches
        assert not live.report.learning
    assert live.report.relearned == 1
    begins = [round(touch.at * PAD.rate) - 200 for touch in ended]
    assert all(abs(begin - place) <= 2 for begin, place in zip(begins[-1:], [290], strict=True))


@pytest.mark.parametrize("steady", [False, True])
def test_a_touch_in_the_first_two_seconds_is_not_learned_as_rest(steady):
    """Learned with it, rest would be so loud that the next touch would be none.

    A finger at a steady speed is as steady as one at rest: only the memory can tell.
    """
    random, count = np.random.default_rng(9), 200 if steady else 50
    own = TactileLearner(sensor=PAD, embedding=SMALL) if steady else learner()
    for material in "abc" * 12 * steady:
        own.observe(material, slide(material, 50, random))
    own.settle()
    rows = np.concatenate([slide("a" if steady else "b", count, random), shift("b", 3)[0]])
    with own.live() as live:
        live.push(rows[: max(120, count)])
        assert live.report.restless and live.report.learning
        [ended] = live.push(rows[max(120, count) :]).touches
        assert not live.report.restless and not live.report.learning and live.report.relearned == 0
    assert ended.prediction.material == "b" and abs(round(ended.at * PAD.rate) - count - 120) <= 2


def test_a_sensor_that_is_never_at_rest_has_its_quietest_two_seconds_for_one():
    random = np.random.default_rng(5)
    rows = 0.02 * random.standard_normal((1200, 12))
    rows[::100] += 0.5 * random.standard_normal((12, 12))
    contacts, detector = found(wide(12), rows[:900])
    assert detector.restless and detector.learning and not contacts
    _, detector = found(wide(12), rows)
    assert not detector.learning and not detector.restless
    kept = [found(wide(12), rows, size=size)[1]._rest.level.tobytes() for size in (1, 7, 10_000)]
    assert len(set(kept)) == 1


def test_fewer_false_contacts_an_hour_ask_for_more():
    random = np.random.default_rng(10)
    rows = 0.02 * random.standard_normal((2000, 12))
    alarms = [found(wide(12), rows, hour)[1]._rest.alarm for hour in (0.01, 1.0, 100.0)]
    assert alarms == sorted(alarms, reverse=True) and alarms[0] > 1.5 * alarms[2] > 0


def test_a_simulated_shift_s_touches_are_found():
    sensor = sensors.ROBOSKIN
    scene = Scene(sensor=sensor)
    shift_ = simulated_shift(scene, scene.materials[:5], seconds=120)
    with TactileLearner(sensor=sensor).live() as live:
        touches = live.push(shift_.readings, time=shift_.times).touches
    assert len(touches) == len(shift_.touches)
    off = [touch.at - truth.begin for touch, truth in zip(touches, shift_.touches, strict=True)]
    assert np.median(np.abs(off)) <= 0.03
    assert live.report.gaps == 5 and live.report.lost > 0


HOLES = {
    "one value": np.s_[100, 1],
    "one reading": np.s_[100],
    "a burst of one channel": np.s_[50:90, 1],
    "a burst of all": np.s_[80:100],
    "infinite": np.s_[100:104, 2],
    "one channel throughout": np.s_[:100, 1],
    "one channel for long": np.s_[:230, 0],
    "all channels for a second": np.s_[:50],
}


def three_channels(holes):
    """What a pad of three channels reads beside what holes leave of it, and where its two touches lie."""
    random = np.random.default_rng(5)
    rows = 0.5 + 0.004 * random.standard_normal((600, 3))
    places = [(170, 220), (400, 450)]
    for begin, end in places:
        rows[begin:end] += 0.1 + 0.1 * np.sin(np.arange(end - begin)[:, None] * (0.4, 0.5, 0.6))
    holed = rows.copy()
    holed[HOLES[holes]] = np.inf if holes == "infinite" else np.nan
    return rows, holed, places


@pytest.mark.parametrize("holes", HOLES)
def test_missing_values_while_rest_is_learned_blind_nothing(holes):
    sensor = wide(3, rate=50.0, low=0.0, high=1.0, duration=1.0, non_finite="missing")
    rows, holed, places = three_channels(holes)
    assert np.abs(np.array(found(sensor, rows)[0]) - places).max() <= 2
    kept = []
    for size in (1, 7, 10_000):
        contacts, detector = found(sensor, holed, size=size)
        assert len(contacts) == 2 and np.abs(np.array(contacts) - places).max() <= 2
        kept.append((contacts, detector._rest.level.tobytes(), detector._rest._scatter.tobytes(), detector._rest.alarm))
    assert kept[0] == kept[1] == kept[2]
    assert np.abs(detector._rest.level / 2**16 - 0.5).max() < 0.01  # that of a channel that came late, too


@pytest.mark.filterwarnings("error")
def test_a_slow_sensors_rest_has_two_blocks_to_be_judged_by():
    rest, random = Rest(wide(3, rate=4.0), 1.0), np.random.default_rng(0)
    still = random.normal(0, 0.01, (rest.needed, 3))
    assert rest.needed >= 2 * rest.block
    moved = still + (np.arange(len(still)) >= rest.block)[:, None]
    assert rest.unrest(rest.whole(still)) < 1 < rest.unrest(rest.whole(moved))


def test_a_block_that_is_learned_is_not_of_readings_before_and_after_a_gap():
    rows = np.random.default_rng(0).normal(0, 0.01, (4000, 3))
    _, whole = found(wide(3), rows)
    late = ContactDetector(wide(3), 1.0)
    late.feed(1 + rows[:7])
    late.interrupt()
    first = 0
    while first < len(rows):
        first += late.feed(rows[first:])[0]
    assert not late.learning and late._rest.mean == whole._rest.mean
