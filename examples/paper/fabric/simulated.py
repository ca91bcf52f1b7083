"""Simulated fabrics under a simulated Contactile-like array, for `fabric contactile`: the paper's set is not public.

It is no model of any real fabric: the constituents' figures are made up, in the order in which textile handbooks put
them, and the weaves are drawn. Nothing measured on it says how real fabrics would be classified. What it keeps of them
is the task: a constituent shows only through the yarn that it is a part of, under two protocols of touching.

>>> from examples.paper.fabric.simulated import FabricScene
>>> scene = FabricScene(seed=0, count=4)
>>> scene.compositions["fabric03"]
{'cotton': 0.25, 'polyester': 0.75}
>>> scene.touch("fabric03", protocol=2, repetition=7)
Stream(contactile, (599, 27), 5.99 s, clipped=0)

A fabric is a relief of crowns, one where yarns cross, with an irregular one of slubs and hairs on it. A pillar carries
its part w of the force F, more where a stiff yarn passes below it, and is dragged along by friction, which on fibres
grows less than the load (Howell's F = a Nⁿ):

    N = F w (1 + stiffness · height),   T = −μ N^n v/|v| + N · slope,   n = 0.9

Protocol 1 is a robot's: one force, one speed, forth and back along one line. Protocol 2 is a hand's: force, speed and
direction vary from touch to touch and within one, it turns back when it likes, the sensor tilts, and the hand trembles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from examples.paper.readers.labelled import Recordings
from scroll_tactile.errors import InputError, UnknownMaterialError
from scroll_tactile.sensors import CONTACTILE, Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["CONSTITUENTS", "HAND", "LIMITS", "ROBOT", "FabricScene", "Fabrics"]

_Floats = npt.NDArray[np.float64]

ROBOT, HAND = 1, 2
"""The two protocols, numbered as the paper does."""

LIMITS = (-2.0, 2.0)
"""Least and largest force of a pillar that the simulated array measures, in N."""


@dataclass(frozen=True)
class _Yarn:
    """What a constituent, or a blend of them, makes of a yarn.

    stiffness: relative to cotton. friction: on the pillars, of 1 N. hair: height in mm of the irregular relief, and
    slub: the length in mm over which it changes. settling: seconds until a pressed yarn has given way.
    """

    stiffness: float
    friction: float
    hair: float
    slub: float
    settling: float


_YARNS = {
    "cotton": _Yarn(1.0, 0.55, 0.020, 1.2, 0.10),
    "elastane": _Yarn(0.1, 0.90, 0.004, 0.4, 0.35),
    "linen": _Yarn(2.8, 0.45, 0.045, 3.5, 0.05),
    "polyester": _Yarn(1.7, 0.32, 0.006, 0.5, 0.06),
    "viscose": _Yarn(0.7, 0.40, 0.012, 0.8, 0.13),
    "wool": _Yarn(0.5, 0.68, 0.060, 2.0, 0.22),
}
CONSTITUENTS = tuple(_YARNS)
"""The six constituents, in alphabetical order."""

_OFTEN = np.array([0.30, 0.12, 0.12, 0.22, 0.12, 0.12])  # that a constituent is drawn
_MOST_ELASTANE = 0.10
_WEAVES = {"plain": 1.0, "rib": 1.4, "satin": 0.5, "twill": 0.8}  # height of its crowns, relative
_FORCE, _SPEED = 5.0, 20.0  # N on all pillars and mm/s, of the robot
_PRESS, _TURN = 0.5, 3.25  # s after which the robot begins to slide, and slides back
_PITCH = 5.0  # mm from pillar to pillar
_TIP = 0.8  # mm over which a pillar's tip averages
_LOAD_POWER = 0.9
_FOLDS = 5
_NOISE, _ZERO = 0.004, 0.01  # N: of a reading, and of a touch
# First word of every seed: a recipe, a weave, the pillars and a touch must never draw the same numbers.
_RECIPE, _CLOTH, _PILLARS, _TOUCH = 11, 12, 13, 14


@dataclass(frozen=True)
class _Cloth:
    """yarn: blended. periods: of the crowns along and across, in mm. crown: their height in mm. lean: of the twill."""

    yarn: _Yarn
    periods: tuple[float, float]
    crown: float
    lean: float


@dataclass(frozen=True)
class _Path:
    """A touch: place (T, 2) in mm, way (T, 2) of length one, force (T,) in N, tilt (T, 2) of the pillars' loads."""

    place: _Floats
    way: _Floats
    force: _Floats
    tilt: _Floats


@dataclass(frozen=True, eq=False)
class Fabrics:
    """recordings: of N touches. protocol: ROBOT or HAND, int of shape (N,).

    compositions: of each fabric, constituent → share by mass; those that are not named are absent.
    """

    recordings: Recordings
    protocol: npt.NDArray[np.int64]
    compositions: dict[str, dict[str, float]]


@dataclass(frozen=True)
class FabricScene:
    """So many fabrics, made of six constituents, and the array that touches them; all of it simulated.

    Raises InputError for a negative seed, or no fabrics.
    """

    seed: int = 0
    count: int = 32

    def __post_init__(self) -> None:
        if self.seed < 0 or self.count < 1:
            raise InputError(f"expected a seed of 0 or more and a fabric or more; came {self.seed} and {self.count}")

    @property
    def fabrics(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(f"fabric{number:02d}" for number in range(1, self.count + 1))

    @property
    def sensor(self) -> Sensor:
        """The array: a `CONTACTILE` of the range LIMITS."""
        return CONTACTILE.model_copy(update={"low": LIMITS[0], "high": LIMITS[1]})

    @cached_property
    def compositions(self) -> dict[str, dict[str, float]]:
        """Fabric → constituent → its share by mass; those that are not named are absent."""
        return {name: _recipe(self.seed, i) for i, name in enumerate(self.fabrics)}

    def touch(self, fabric: str, protocol: int, repetition: int) -> Stream:
        """A touch of (599, 27) N, channels pillar by pillar, x, y and z of each; a function of its arguments.

        protocol: ROBOT or HAND. Raises UnknownMaterialError for a fabric that is not there, and InputError for another
        protocol or a negative repetition.
        """
        if fabric not in self.fabrics:
            raise UnknownMaterialError(f"expected a fabric from fabric01 to {self.fabrics[-1]}; came {fabric!r}")
        if protocol not in (ROBOT, HAND) or repetition < 0:
            raise InputError(
                f"expected protocol {ROBOT} or {HAND} and a repetition of 0 or more; came {protocol}, {repetition}"
            )
        i = self.fabrics.index(fabric)
        random = np.random.default_rng([_TOUCH, self.seed, i, protocol, repetition])
        times = np.arange(CONTACTILE.readings) / CONTACTILE.rate
        cloth = _cloth(self.seed, i)
        path = _robot(times, random) if protocol == ROBOT else _hand(times, random)
        forces = _slide(cloth, path, times, random, _loads(self.seed))
        return validate(np.clip(forces.astype(np.float32), *LIMITS), self.sensor)

    def touched(self, robot: int = 40, hand: int = 10) -> Fabrics:
        """So many touches of each fabric under either protocol; the scene's seed deals them into five folds."""
        counts = {ROBOT: robot, HAND: hand}
        marks = [(name, side, i) for name in self.fabrics for side, count in counts.items() for i in range(count)]
        folds = [
            np.random.default_rng([self.seed, place, side]).permutation(np.arange(count) % _FOLDS)
            for place in range(self.count)
            for side, count in counts.items()
        ]
        recordings = Recordings(
            name="simulated fabrics",
            sensor=self.sensor,
            streams=[self.touch(*mark) for mark in marks],
            materials=[name for name, *_ in marks],
            repetition=np.array([i for *_, i in marks]),
            fold=np.concatenate(folds),
            ordered=False,
        )
        return Fabrics(recordings, np.array([side for _, side, _ in marks]), self.compositions)


def _recipe(seed: int, i: int) -> dict[str, float]:
    """One to three constituents in steps of 5 %; elastane is never more than a tenth, and so never alone."""
    random = np.random.default_rng([_RECIPE, seed, i])
    number = int(random.choice([1, 2, 3], p=[0.25, 0.5, 0.25]))
    drawn = [
        CONSTITUENTS[constituent] for constituent in random.choice(len(CONSTITUENTS), number, replace=False, p=_OFTEN)
    ]
    steps = {}
    if "elastane" in drawn:
        drawn = [constituent for constituent in drawn if constituent != "elastane"] or ["cotton"]
        steps["elastane"] = int(random.integers(1, round(_MOST_ELASTANE * 20) + 1))
    left = 20 - sum(steps.values())
    cuts = np.sort(random.choice(np.arange(3, left - 2), len(drawn) - 1, replace=False))
    sizes = np.diff([0, *cuts.tolist(), left])
    steps |= {constituent: int(size) for constituent, size in zip(drawn, sizes, strict=True)}
    return {constituent: steps[constituent] / 20 for constituent in sorted(steps)}


@lru_cache(maxsize=256)
def _cloth(seed: int, i: int) -> _Cloth:
    """A yarn blended by mass, its stiffness in logarithms, in a weave that has nothing to do with what it is of."""
    shares = _recipe(seed, i)
    random = np.random.default_rng([_CLOTH, seed, i])

    def mean(what: str) -> float:
        return sum(share * float(getattr(_YARNS[constituent], what)) for constituent, share in shares.items())

    stiffness = math.exp(sum(share * math.log(_YARNS[constituent].stiffness) for constituent, share in shares.items()))
    yarn = _Yarn(stiffness, mean("friction"), mean("hair"), mean("slub"), mean("settling"))
    weave = str(random.choice(list(_WEAVES)))
    period = math.exp(random.uniform(math.log(0.9), math.log(2.8)))
    across = period * random.uniform(0.7, 1.4)
    return _Cloth(yarn, (period, across), 0.1 * _WEAVES[weave] * period, 1.0 if weave == "twill" else 0.0)


@lru_cache(maxsize=16)
def _loads(seed: int) -> _Floats:
    """The part of the force that each of nine pillars carries, most in the middle; shape (9,), sum one."""
    shape = np.array([[0.8, 1.0, 0.8], [1.0, 1.6, 1.0], [0.8, 1.0, 0.8]])
    uneven = np.random.default_rng([_PILLARS, seed]).uniform(0.9, 1.1, 9)
    loads: _Floats = shape.reshape(-1) * uneven
    loads /= loads.sum()
    return loads


def _robot(times: _Floats, random: np.random.Generator) -> _Path:
    """Pressed, then slid forth and back along x at one force and one speed; the cloth is laid down nearly straight."""
    angle = random.normal(0, math.radians(2)) + math.pi * (times > _TURN)
    speed = _SPEED * math.exp(random.normal(0, 0.01)) * (times > _PRESS)
    force = _FORCE * math.exp(random.normal(0, 0.03))
    tilt = np.tile(random.normal(0, 0.02, 2), (len(times), 1))
    return _path(np.asarray(angle, np.float64), np.asarray(speed), np.full(len(times), force), tilt, random)


def _hand(times: _Floats, random: np.random.Generator) -> _Path:
    """Rubbed forth and back, not quite along x, as firmly and as fast as it happens, with the tremor of a hand."""

    def wander(least: float, most: float) -> _Floats:
        """Slow and of about unit variance: three waves."""
        waves = [random.uniform(least, most) for _ in range(3)]
        turns = random.uniform(0, 2 * math.pi, 3)
        total = sum(np.sin(2 * math.pi * wave * times + turn) for wave, turn in zip(waves, turns, strict=True))
        return np.asarray(total * math.sqrt(2 / 3))

    tremor = np.sin(2 * math.pi * random.uniform(8, 12) * times + random.uniform(0, 2 * math.pi))
    force = _FORCE * np.exp(random.normal(0, 0.3) + 0.2 * wander(0.2, 1.5) + 0.02 * tremor)
    speed = _SPEED * np.exp(random.normal(0, 0.3) + 0.3 * wander(0.2, 1.0)) * (times > random.uniform(0.1, 0.8))
    angle = random.normal(0, math.radians(15)) + 0.1 * wander(0.1, 0.5)
    angle = angle + math.pi * (np.floor(times / random.uniform(1.5, 4.0) + random.integers(2)) % 2)
    tilt = np.stack([random.normal(0, 0.1) + 0.05 * wander(0.2, 1.0) for _ in range(2)], axis=1)
    return _path(np.asarray(angle), np.asarray(speed), np.asarray(force), tilt, random)


def _path(angle: _Floats, speed: _Floats, force: _Floats, tilt: _Floats, random: np.random.Generator) -> _Path:
    way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    place = random.uniform(0, 50, 2) + np.cumsum(way * speed[:, None], axis=0) / CONTACTILE.rate
    return _Path(place, way, force, tilt)


def _slide(cloth: _Cloth, path: _Path, times: _Floats, random: np.random.Generator, loads: _Floats) -> _Floats:
    """Forces in N, (T, 27): of each pillar x, y and z."""
    rows, columns = np.divmod(np.arange(9), 3)
    offsets = np.stack([columns - 1, rows - 1], axis=1).astype(np.float64)
    where = path.place[:, None] + _PITCH * offsets  # (T, 9, 2)
    height, slope = _relief(cloth, where, random)
    leaning = np.clip(1 + path.tilt @ offsets.T, 0.1, None)
    settled = -np.expm1(-times / cloth.yarn.settling)
    load = path.force[:, None] * settled[:, None] * leaning * loads
    normal = load * np.clip(1 + cloth.yarn.stiffness**0.4 * height / 0.25, 0.05, None)
    drag = cloth.yarn.friction * normal**_LOAD_POWER
    moving = np.linalg.norm(np.diff(path.place, axis=0, prepend=path.place[:1]), axis=1) > 0
    shear = -(drag * np.where(moving, 1.0, 0.2)[:, None])[..., None] * path.way[:, None] + normal[..., None] * slope
    forces = np.concatenate([shear, normal[..., None]], axis=2).reshape(len(times), -1)
    zero = random.normal(0, _ZERO, forces.shape[1])
    felt: _Floats = forces + zero + _NOISE * random.standard_normal(forces.shape)
    return felt


def _relief(cloth: _Cloth, where: _Floats, random: np.random.Generator) -> tuple[_Floats, _Floats]:
    """Height in mm, (T, 9), and slope, (T, 9, 2), at places (T, 9, 2) in mm, averaged over a pillar's tip."""
    height, slope = np.zeros(where.shape[:2]), np.zeros(where.shape)
    turns = random.uniform(0, 2 * math.pi, 2)
    for axis, (period, turn) in enumerate(zip(cloth.periods, turns, strict=True)):
        wave = np.zeros(2)
        wave[axis] = 2 * math.pi / period
        wave[1 - axis] = cloth.lean * wave[axis] * (1 if axis == 0 else 0)
        # A tip of that width sees a wave as a Gaussian window does.
        seen = 0.5 * cloth.crown * math.exp(-((float(np.linalg.norm(wave)) * _TIP / 2) ** 2) / 8)
        phase = where @ wave + turn
        height += seen * np.sin(phase)
        slope += seen * np.cos(phase)[..., None] * wave * 0.2  # pillars are soft: a fifth of the slope is felt
    # The irregular relief: another one below each pillar, over the way that it has gone.
    gone = np.cumsum(np.linalg.norm(np.diff(where[:, 0], axis=0, prepend=where[:1, 0]), axis=1)) / cloth.yarn.slub
    knots = random.standard_normal((math.ceil(gone[-1]) + 2, where.shape[1]))
    before = gone.astype(np.int64)
    part = (gone - before)[:, None]
    height += cloth.yarn.hair * ((1 - part) * knots[before] + part * knots[before + 1])
    return height, slope
