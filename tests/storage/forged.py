"""Rows, payloads and generations as somebody else could make them: their checksums are right, as these have no key."""

import json
import subprocess
import sys
import textwrap

from forging import Named, Packed, as_text, name_generation, pack, sealed

from store.content import ArrayContent
from store.encoding import array_digest


def payload(arrays, version=1):
    """The bytes of a payload; arrays: (name, dtype, shape, codec, bytes of the array, buffer)."""
    return pack([Packed(*array) for array in arrays], version)


def put_generation(path, number, content, *, upto=1, base=0, time=1.0, attributes="{}"):
    """Name a generation in the journal of the store in `path`; content: JSON's values, or its text."""
    name_generation(path, Named(number, upto, base, time, attributes, as_text(content)))


def describe_again(folder, **changes):
    """Change what a generation says of itself, and make its sha256 anew."""
    header = folder / "zarr.json"
    group = json.loads(header.read_text())
    known = group["attributes"] | changes
    known.pop("sha256", None)
    group["attributes"] = sealed(known)
    header.write_text(json.dumps(group))
    return {"format": known["format"], "arrays": known["arrays"]}


def in_a_process(code, *arguments, memory=2**30, seconds=60):
    """Run code in a process that may die, with this much memory more than it has after its imports."""
    limited = f"""
        import resource, sys
        import numpy, store, numcodecs.blosc, numcodecs.zstd, zarr
        held = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + {memory}, held + {memory}))
    """
    command = [sys.executable, "-c", textwrap.dedent(limited) + textwrap.dedent(code), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)


def write_first_format(folder, arrays, *, rows=None, level=3, **known):
    """Write a group as releases up to 0.4 did, with Blosc; rows: in shards as up to 0.2. Return its content."""
    import zarr
    from zarr.codecs import BloscCodec
    from zarr.storage import LocalStore

    described = {
        name: {"dtype": array.dtype.str, "shape": list(array.shape), "sha256": array_digest(array)}
        for name, array in arrays.items()
    }
    content = {"format": 1, "arrays": described}
    known = {"number": 1, "upto": 1, "attributes": {}, "identity": {}} | known | content
    group = zarr.create_group(store=LocalStore(folder), zarr_format=3, attributes=sealed(known))
    for name, array in arrays.items():
        plain = array.view("<u4").reshape(*array.shape, -1) if array.dtype.kind == "U" else array
        chunks = {"chunks": ArrayContent(array.dtype, array.shape, "").chunk}
        if rows is not None and plain.ndim:
            rest = tuple(max(1, length) for length in plain.shape[1:])
            chunks = {"chunks": (rows, *rest), "shards": (rows * max(1, -(-len(plain) // rows)), *rest)}
        target = group.create_array(
            name,
            shape=plain.shape,
            dtype=plain.dtype,
            **chunks,
            compressors=BloscCodec(cname="zstd", clevel=level, shuffle="shuffle"),
            fill_value=0,
            attributes={"dtype": array.dtype.str},
            config={"write_empty_chunks": True},
        )
        target[...] = plain
    return content
