"""Checks for the tests of those who write their own part: whether it keeps the promises that exactness rests on."""

from scroll_tactile.testing.embedding_checks import check_embedding
from scroll_tactile.testing.learner_checks import check_learner

__all__ = ["check_embedding", "check_learner"]
