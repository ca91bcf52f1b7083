"""Systems and embeddings of one's own by `module:factory`, measured like every other.

A factory is called without arguments, for each cell anew, and makes a `System`; one of an embedding is called once.
`module:factory` names a system, `module:factory-lda` and `module:factory-ridge` ours on an embedding of one's own.
"""

from __future__ import annotations

import re
from hashlib import blake2b
from importlib import import_module
from inspect import getsourcefile
from pathlib import Path
from typing import Any

from examples.paper.systems.system_protocol import System
from scroll_tactile import Embedding, Joined, Kernels, Vision
from scroll_tactile.embeddings.protocol import is_embedding
from scroll_tactile.errors import InputError

__all__ = [
    "code_digest",
    "frozen_embedding",
    "is_own",
    "is_own_embedding",
    "own_embedding",
    "own_system",
    "require_own",
]

SPELLED = re.compile(r"([\w.]+):([\w.]+)(-lda|-ridge)?")


def is_own(key: str) -> bool:
    """Whether a system's key is `module:factory`, with a readout behind it or without."""
    return SPELLED.fullmatch(key) is not None


def is_own_embedding(key: str) -> bool:
    """Whether a system's key is ours on an embedding of one's own."""
    return is_own(key) and key.endswith(("-lda", "-ridge"))


def require_own(key: str) -> None:
    """Raise InputError where a key of one's own makes no system, or no embedding."""
    if is_own_embedding(key):
        own_embedding(key)
    else:
        own_system(key)


def own_system(key: str) -> System:
    """A new system, not fitted. Raises InputError where it is not there, cannot be made, or is something else."""
    made = _made(key)
    if not isinstance(made, System):
        raise InputError(
            f"expected {key} to make a system, with name, fit(streams, materials, validation, seed, progress, watch) "
            f"and predict(streams); it makes {_kind(made)}. See examples/own_system.py"
        )
    return made


def own_embedding(key: str) -> Embedding:
    """The embedding in `module:factory`, whatever readout stands behind it.

    Raises InputError where it is not there, cannot be made, or is something else.
    """
    made = _made(key)
    if isinstance(made, type) or not is_embedding(made):
        raise InputError(
            f"expected {':'.join(_parts(key))} to make an embedding, with name, dimension, bound, fingerprint and "
            f"embed(image); it makes {_kind(made)}. See examples/own_system.py"
        )
    embedding: Embedding = made  # type: ignore[assignment]  # it has what the protocol asks for
    return embedding


def frozen_embedding(choice: str, weights: str | None, features: int | None) -> Embedding:
    """The frozen features of a name, or one's own; raises InputError for others, and for weights that do not fit."""
    if choice not in ("kernels", "vision", "kernels+vision") and not is_own(choice):
        raise InputError(f"expected --embedding kernels, vision, kernels+vision, or module:factory; came {choice!r}")
    if choice == "kernels" or is_own(choice):
        if weights is not None:
            raise InputError(f"--embedding {choice} has no weights; came {weights!r}. Leave --weights out")
        return own_embedding(choice) if is_own(choice) else Kernels(dimension=features or 1008)
    if weights is None:
        raise InputError(f"--embedding {choice} needs --weights: a file, or a published name such as resnet18")
    # Beside vision 1260 kernels have 98.7 % of RoboSkin, 1008 have 98.6; both have 99.5 of BioTac.
    vision = Vision(weights)
    return vision if choice == "vision" else Joined(Kernels(dimension=features or 1260), vision)


def code_digest(key: str) -> str:
    """16 hex digits of a hash of the file that a key of one's own lies in: what a run of it cannot be resumed with."""
    file = getsourcefile(import_module(_parts(key)[0]))
    return blake2b(Path(file).read_bytes() if file else b"", digest_size=8).hexdigest()


def _parts(key: str) -> tuple[str, str]:
    match = SPELLED.fullmatch(key)
    if match is None:
        raise InputError(f"expected module:factory, such as examples.own_system:NearestMean; came {key!r}")
    return match[1], match[2]


def _made(key: str) -> object:
    module, factory = _parts(key)
    try:
        found = import_module(module)
    except ImportError as error:
        raise InputError(
            f"{key}: the module {module} cannot be imported from here: {error}. Run from its folder, or install it"
        ) from error
    make: Any = found
    for name in factory.split("."):
        make = getattr(make, name, None)
    if make is None:
        raise InputError(f"{key}: {module} has no {factory}; {getsourcefile(found) or 'it'} was imported")
    if not callable(make):
        raise InputError(f"expected {key} to be a class or a function to call; it is {_kind(make)}")
    try:
        return make()
    except TypeError as error:
        raise InputError(f"expected {key} to be called without arguments: {error}") from error


def _kind(value: object) -> str:
    return f"the class {value.__name__}" if isinstance(value, type) else f"of type {type(value).__name__}"
