"""Weights of residual networks: read from files that may be damaged, hostile or another architecture's, or fetched.

Read are `.safetensors` and what `torch.save` writes, in torchvision's names and those of Meta-Dataset's universal
representations: bare, or within a checkpoint, with the prefixes that wrappers leave. Classifiers are left out.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import re
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from scroll_tactile.embeddings.protocol import cache_folder
from scroll_tactile.embeddings.resnet import ResNet, Stem
from scroll_tactile.errors import WeightsError
from scroll_tactile.libraries import optional

with optional("torch", "torch", "a network's weights"):
    import torch

__all__ = [
    "PUBLISHED",
    "digest_of",
    "hash_tensors",
    "load_network",
    "read_tensors",
    "source_name",
]

Tensors = dict[str, torch.Tensor]

# torchvision's; a name ends in the first eight hex digits of the file's SHA-256.
PUBLISHED: Final = {"resnet18": "https://download.pytorch.org/models/resnet18-f37072fd.pth"}
CONTAINERS = ("state_dict", "model_state_dict", "model", "net", "backbone")  # under which checkpoints keep the tensors
PREFIXES = re.compile(r"^(?:(?:module|backbone|model|encoder|net)\.)+")  # left by wrappers around the network
HEADS = re.compile(r"^(?:fc|cls_fn|classifier)\.|(?:^|\.)num_batches_tracked$")
NAMED = 5  # tensors in a message


def load_network(source: str | os.PathLike[str] | Mapping[str, torch.Tensor]) -> ResNet:
    """Make the network of a published name, a file or a state dict, in float32 and evaluation mode.

    source: "resnet18" for torchvision's ImageNet weights, fetched once into the cache; the path of a `.safetensors`,
    `.pth` or `.pt` file; or tensors by name.

    Raises WeightsError for weights that cannot be had, are damaged, or belong to another architecture.
    """
    if isinstance(source, Mapping):
        return _network_of(source, "the given state dict")
    path = _published(source) if isinstance(source, str) and source in PUBLISHED else Path(source)
    return _network_of(read_tensors(path), str(path))


def source_name(source: str | os.PathLike[str] | Mapping[str, torch.Tensor] | None) -> str | None:
    """What a source of weights is called on any machine: a published name or a file's, None for tensors or nothing."""
    return None if source is None or isinstance(source, Mapping) else Path(source).name


def hash_tensors(digest: hashlib._Hash, net: ResNet) -> None:
    """Add a network's tensors to a hash: names, shapes and bytes, in the order of the names."""
    for name, tensor in sorted(net.state_dict().items()):
        digest.update(f"\n{name} {tuple(tensor.shape)}".encode())
        digest.update(tensor.contiguous().numpy().tobytes())


def digest_of(net: ResNet) -> str:
    """Hex of a SHA-256 over a network's tensors, whatever file they came from."""
    digest = hashlib.sha256()
    hash_tensors(digest, net)
    return digest.hexdigest()


def read_tensors(path: Path) -> Mapping[str, Any]:
    """What a file holds: tensors by name, or a checkpoint that has them inside. Nothing in it is executed.

    Raises WeightsError for a file that is not there, damaged, or a pickle of more than tensors and plain values.
    """
    if not path.is_file():
        raise WeightsError(
            f"expected a file of weights; there is none at {path}. Give a .safetensors or .pth file, or "
            "'resnet18', which is fetched"
        )
    if path.suffix == ".safetensors":
        return _read_safetensors(path)
    try:
        with _numpy_scalars_allowed():
            held = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        said = str(error).partition("\n")[0]
        raise WeightsError(
            f"{path} is no file of tensors: it is damaged, or a pickle that would execute code when it is read, "
            f"which is refused. If you trust its maker, read it there and save its state dict alone "
            f"({said:.200})"
        ) from error
    except Exception as error:  # a flipped bit makes torch's reader fail in any way: assertions and struct.error too
        raise WeightsError(f"{path} cannot be read as what torch.save writes: it is damaged or cut off") from error
    if not isinstance(held, Mapping):
        raise WeightsError(f"expected tensors by name in {path}; it holds a {type(held).__name__}")
    return held


def _network_of(tensors: Mapping[str, Any], where: str) -> ResNet:
    """Make the network that tensors belong to; its stem is read off their shapes.

    where: what messages call their source. The tensors are copied.

    Raises WeightsError that names what is missing, left over, of another shape, or not finite.
    """
    given = _cleaned(tensors, where)
    stem = _stem(given, where)
    net = ResNet.empty(stem)
    wanted = {name: t for name, t in net.state_dict().items() if not HEADS.search(name)}
    kind = f"a ResNet-18 with the {stem} stem"
    if missing := sorted(set(wanted) - set(given)):
        raise WeightsError(f"{where} looks like {kind}, but lacks {_listed(missing)}")
    if extra := sorted(set(given) - set(wanted)):
        raise WeightsError(f"{where} looks like {kind}, but also has {_listed(extra)}: it is another architecture's")
    for name, own in wanted.items():
        tensor = given[name]
        if tensor.shape != own.shape or not tensor.is_floating_point():
            raise WeightsError(
                f"{where} looks like {kind}, but {name} is {tensor.dtype} of shape {tuple(tensor.shape)}; "
                f"expected floats of shape {tuple(own.shape)}"
            )
        own.copy_(tensor.detach())
        # Looked at after rounding to float32: a double may be too large for it.
        if not torch.isfinite(own).all() or (name.endswith("running_var") and (own < 0).any()):
            raise WeightsError(f"{name} in {where} has NaN, infinite or impossible values: the file is damaged")
    return net


def _published(name: str) -> Path:
    """The file of a published name, fetched where the cache has none."""
    url = PUBLISHED[name]
    path = cache_folder("weights") / url.rsplit("/", 1)[1]
    expected = path.stem.rsplit("-", 1)[1]
    if not path.is_file():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # Into a file beside it, which is compared and then renamed: what is there is whole.
            torch.hub.download_url_to_file(url, str(path), expected, progress=False)
        except Exception as error:  # the downloader's errors are many: no network, no room, a proxy that refuses
            raise WeightsError(
                f"the weights {name!r} could not be fetched from {url} ({type(error).__name__}: {error!s:.200}). "
                f"Put that file at {path} by hand, or give Vision the path of a file of weights, or use Kernels, "
                "which need none"
            ) from error
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if not digest.startswith(expected):
        raise WeightsError(
            f"{path} is damaged: its SHA-256 begins with {digest[:8]}, where its publisher's name says {expected}. "
            "Delete it, so that it is fetched again"
        )
    return path


def _read_safetensors(path: Path) -> Tensors:
    with optional("safetensors", "vision", str(path)):
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    try:
        return load_file(path)
    except (SafetensorError, OSError, ValueError, KeyError) as error:
        raise WeightsError(f"{path} cannot be read as safetensors: {error}. It is damaged or cut off") from error


def _numpy_scalars_allowed() -> AbstractContextManager[None]:
    """Checkpoints often hold a best accuracy that is a NumPy scalar, beside the tensors; to read one runs nothing."""
    scalar: Any = np.float64(0).__reduce__()[0]
    kinds = [type(np.dtype(kind)) for kind in ("f8", "f4", "i8", "i4", "?")]
    names = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
    allowed = torch.serialization.safe_globals([np.dtype, *kinds, scalar, *((scalar, name) for name in names)])
    return cast(AbstractContextManager[None], allowed)


def _cleaned(tensors: Mapping[str, Any], where: str) -> Tensors:
    """The network's tensors, by torchvision's names."""
    for _ in CONTAINERS:  # each within another, at most; one may hold itself
        tensors = next((held for name in CONTAINERS if isinstance(held := tensors.get(name), Mapping)), tensors)
    named = {PREFIXES.sub("", str(name)): tensor for name, tensor in tensors.items()}
    kept = {name: tensor for name, tensor in named.items() if not HEADS.search(name)}
    dense = {n for n, t in kept.items() if isinstance(t, torch.Tensor) and t.layout == torch.strided and not t.is_meta}
    if strange := kept.keys() - dense:
        raise WeightsError(f"expected dense tensors by name in {where}; {_listed(sorted(strange))} are none")
    return kept


def _stem(tensors: Tensors, where: str) -> Stem:
    first = tensors.get("conv1.weight")
    kernel = tuple(first.shape[2:]) if first is not None else None
    blocks = {match[0] for name in tensors if (match := re.match(r"layer[1-4]\.\d+\.", name))}
    stems: dict[object, Stem] = {(7, 7): "torchvision", (5, 5): "universal"}
    if kernel in stems and blocks == {f"layer{layer}.{block}." for layer in (1, 2, 3, 4) for block in (0, 1)}:
        return stems[kernel]
    raise WeightsError(
        f"expected in {where} a ResNet-18, two blocks in each of layer1 to layer4, with a first convolution "
        f"conv1.weight of 7 × 7 (torchvision) or 5 × 5 (universal); found a first kernel of {kernel} and {len(blocks)} "
        f"blocks, among {len(tensors)} tensors ({_listed(sorted(tensors))})"
    )


def _listed(names: list[str]) -> str:
    rest = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {rest} more" if rest > 0 else "")
