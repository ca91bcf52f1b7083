"""A fleet that shares what its robots felt: memories merged, beside averages of networks trained robot by robot.

Touches are dealt by Dirichlet shares, so that robots meet different materials, the more the smaller α is.
"""

from __future__ import annotations

import copy
import shutil
import tempfile
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from examples.paper.runs.cells import Figures, learn
from examples.paper.systems.descent import seeded
from scroll_tactile import Embedding
from scroll_tactile.clients.learning.metrics import Labelled, accuracy
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.results import Prediction
from scroll_tactile.sensors import Sensor

__all__ = ["Fleet", "deal", "federated"]

FloatArray = npt.NDArray[np.float64]
Part = tuple[torch.Tensor, torch.Tensor]
"""Standardised features (N, d) of a robot's touches, and the places of their materials (N,)."""

HIDDEN = 128
RATE = 1.0  # of 0.3, 1, 3, 10 the best for one robot that has everything, on the tests of fold 0: in their favour
PLANS = {"1 round": (1, 40), "20 rounds": (20, 2)}
"""How often the networks are averaged, and epochs on each robot between, 40 in all; the first is one-shot averaging."""


def deal(materials: Sequence[str], robots: int, alpha: float, seed: int) -> list[list[int]]:
    """The touches of each robot: each material has shares of Dirichlet(α) over the robots, and deals its own by them.

    The split of Hsu et al. 2019 (arXiv 1909.06335). materials: of each of N touches. A robot may get none.

    Raises InputError for fewer robots than one, or an α that is not positive.
    """
    if robots < 1 or not alpha > 0:
        raise InputError(f"expected 1 or more robots and a positive α; came {robots} and {alpha}")
    random = np.random.default_rng([seed, 7])
    shares = {name: random.dirichlet(np.full(robots, alpha)) for name in sorted(set(materials))}
    dealt: list[list[int]] = [[] for _ in range(robots)]
    for i, name in enumerate(materials):
        dealt[int(random.choice(robots, p=shares[name]))].append(i)
    return dealt


def federated(
    parts: Sequence[Part], make: Callable[[], nn.Module], rounds: int, epochs: int, seed: int = 0
) -> nn.Module:
    """Federated averaging (McMahan et al. 2017, arXiv 1602.05629): all robots take part in each round.

    Each trains a copy by SGD on batches of 10; the next is their mean, weighted by touches. make: the first network.
    """
    with seeded(seed, "cpu"):
        whole = make()
        total = sum(len(places) for _, places in parts)
        for _ in range(rounds):
            mean = {name: torch.zeros_like(value) for name, value in whole.state_dict().items()}
            for part in parts:
                local = copy.deepcopy(whole)
                _descend(local, part, epochs)
                for name, value in local.state_dict().items():
                    mean[name] += value * (len(part[1]) / total)
            whole.load_state_dict(mean)
    return whole


def _descend(network: nn.Module, part: Part, epochs: int, batch: int = 10) -> None:
    rows, places = part
    descent = torch.optim.SGD(network.parameters(), lr=RATE)
    for _ in range(epochs):
        for chosen in torch.split(torch.randperm(len(places)), batch):
            descent.zero_grad()
            torch.autograd.backward(nn.functional.cross_entropy(network(rows[chosen]), places[chosen]))
            descent.step()


class Fleet:
    """One fold's touches, to be dealt to fleets.

    train, test: the touches; trained, tested: the networks' vectors of these, shapes (N, d) and (M, d). They are
    standardised by all training touches, which a fleet could agree on, and which favours the networks.
    """

    def __init__(
        self,
        sensor: Sensor,
        embedding: Embedding,
        train: Sequence[Labelled],
        test: Sequence[Labelled],
        trained: FloatArray,
        tested: FloatArray,
    ) -> None:
        self._sensor, self._embedding = sensor, embedding
        self._train, self._test = train, test
        self._truth = [name for name, _ in test]
        self._names = sorted({name for name, _ in train})
        mean, spread = trained.mean(axis=0), np.maximum(trained.std(axis=0), 1e-6)
        self._trained, self._tested = (
            torch.tensor(np.clip((rows - mean) / spread, -5, 5) / np.sqrt(len(mean)), dtype=torch.float32)
            for rows in (trained, tested)
        )
        self._places = torch.tensor([self._names.index(name) for name, _ in train])

    def measure(self, robots: int, alpha: float, seed: int, progress: Progress) -> Figures:
        """Ours, merged, against one robot's; and networks averaged, in as many rounds as PLANS says."""
        dealt = [own for own in deal([name for name, _ in self._train], robots, alpha, seed) if own]
        digest, answers = self._merged(dealt, progress)
        averaged = {
            net: {when: self._averaged(dealt, net == "MLP", *plan, seed) for when, plan in PLANS.items()}
            for net in ("linear", "MLP")
        }
        return {
            "robots": robots,
            "alpha": alpha,
            "busy": len(dealt),
            "least": min(map(len, dealt)),
            "most": max(map(len, dealt)),
            "digest": digest,
            "same_bytes": digest == self._one_robot[0],
            "same_answers": answers == self._one_robot[1],
            "accuracy": accuracy(self._truth, [answer.material for answer in answers]),
            "averaged": averaged,
        }

    @cached_property
    def _one_robot(self) -> tuple[str, list[Prediction]]:
        """The digest and the answers of one robot that felt everything, in the order of the set."""
        learner = TactileLearner(sensor=self._sensor, embedding=self._embedding, exemplars=0)
        return learn(learner, self._train).digest(), self._answers(learner)

    def _answers(self, learner: TactileLearner) -> list[Prediction]:
        learner.settle()
        return [learner.predict(stream) for _, stream in self._test]

    def _merged(self, dealt: Sequence[Sequence[int]], progress: Progress) -> tuple[str, list[Prediction]]:
        """Every robot has a memory of its own, and one takes them all over, by `TactileLearner.merge`."""
        with tempfile.TemporaryDirectory(prefix="scroll-tactile-") as name:
            folder = Path(name)
            with self._open(folder / "all") as joint:
                for done, own in enumerate(dealt):
                    progress("robots", done, len(dealt))
                    with self._open(folder / "robot") as robot:
                        learn(robot, [self._train[i] for i in own])
                    joint.merge(folder / "robot")
                    shutil.rmtree(folder / "robot")
                return joint.digest(), self._answers(joint)

    def _open(self, path: Path) -> TactileLearner:
        return TactileLearner.open(path, sensor=self._sensor, embedding=self._embedding, exemplars=0)

    def _averaged(self, dealt: Sequence[Sequence[int]], deep: bool, rounds: int, epochs: int, seed: int) -> float:
        parts = [(self._trained[own], self._places[own]) for own in map(list, dealt)]
        network = federated(parts, lambda: self._network(deep), rounds, epochs, seed)
        with torch.no_grad():
            found = network(self._tested).argmax(dim=1).tolist()
        return accuracy(self._truth, [self._names[i] for i in found])

    def _network(self, deep: bool) -> nn.Module:
        width, outputs = self._trained.shape[1], len(self._names)
        if not deep:
            return nn.Linear(width, outputs)
        return nn.Sequential(nn.Linear(width, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, outputs))
