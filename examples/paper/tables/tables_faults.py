"""The README's section on what was survived, from the reports of `tests/faults`."""

from __future__ import annotations

from collections.abc import Mapping

from examples.paper.tables.markdown import Read, Result

__all__ = ["faults"]

HEAD = "| fault | how often | acknowledged and lost | |\n|---|---|---|---|"


def faults(read: Read) -> str:
    """A table of the faults, and in words what is kept of a touch and what keeping it takes."""
    each, flips = read("faults-each-call"), read("faults-bit-flips")
    rows = [
        (
            "kill -9 at a random instant of observe, batch, retract, forget, merge, compact, fine_tune, open, close",
            _thousands(read("faults-kill")["kills"]),
            _failures(read("faults-kill")),
            "digest, exemplars and f\\* are those of the acknowledged list, or of it and the one call that had begun",
        ),
        (
            "an error, a torn write or a crash at each file operation in turn (SQLite's too"
            + ("" if each["every"]["calls"] == 1 else f"; one of {each['every']['calls']}")
            + ")",
            _thousands(sum(each["calls"].values())),
            _failures(each),
            "typed errors, and on it goes when the disk does",
        ),
        (
            "power cut: unsynced writes and renames dropped, torn or reordered",
            f"{_thousands(read('faults-power-cut')['disks'])} disks",
            _failures(read("faults-power-cut")),
            "",
        ),
        (
            "one bit flipped, anywhere",
            _thousands(flips["flips"]),
            f"{len(flips['failures'])} wrong answers",
            _flips(flips["outcomes"]),
        ),
        (
            "a full disk, a disk that can only be read, one that fails in the middle",
            f"{_thousands(read('faults-disk')['operations'])} operations",
            _failures(read("faults-disk")),
            "typed errors; it goes on when there is room",
        ),
        (
            "two writers, a reader beside a writer, eight readers",
            f"{_thousands(sum(read('faults-processes')['readers']['looks'].values()))} looks",
            _failures(read("faults-processes")),
            "no torn read, no lost write",
        ),
        (
            "any calls in any order (hypothesis's state machine against a list)",
            f"{_thousands(read('faults-history')['steps'])} steps",
            _failures(read("faults-history")),
            "no counterexample",
        ),
    ]
    table = "\n".join([HEAD, *(f"| {' | '.join(row)} |".replace("|  |", "| |") for row in rows)])
    return f"{table}\n\n{_space(read('faults-space'))}\n{_latency(read('faults-latency'))}"


def _thousands(count: int) -> str:
    return f"{count:,}"


def _failures(record: Result) -> str:
    return str(len(record["failures"]))


def _flips(outcomes: Mapping[str, int]) -> str:
    nothing = outcomes.get("right; check finds nothing", 0)
    end = sum(count for words, count in outcomes.items() if words.startswith("the end of the log"))
    return (
        f"{nothing} mattered to nothing, {end} in the last commit of a log that was not closed, all others found by "
        "`memory check`"
    )


def _space(record: Result) -> str:
    large, kept = record["large"], record["bytes"]
    count, opened = _thousands(large["observations"]), large["seconds to open"]
    kilobytes = {name: size / 1e3 for name, size in kept.items()}
    return (
        f"{count} observations, compacted, open in {max(opened):.1f} s at most. On disk a touch of BioTac "
        f"is {kilobytes['an observation, with readings']:.0f} KB with its readings,\n"
        f"{kilobytes['an observation, without readings']:.0f} without (`exemplars=0`), "
        f"{kilobytes['an observation, compacted (what is known of it)']:.1f} compacted; a material "
        f"{kilobytes['a material, in a generation']:.0f} KB."
    )


def _latency(record: Result) -> str:
    ours, small = record["BioTac, 1008 features"], record["tiny, 64 features, exemplars=0"]
    slow = ", each sync 30 ms longer"
    batch, bulk = record["bulk: BioTac, 1008 features"], record["bulk: BioTac, 1008 features" + slow]
    of_small = record["bulk: tiny, 64 features, exemplars=0" + slow]
    took = {name: (ours[name]["p50 ms"], ours[name]["p99 ms"]) for name in ("observe", "store.append", "file")}
    return (
        "A durable `observe` of it takes {:.1f} ms (p99 {:.0f}), the embedding left out, ".format(*took["observe"])
        + "the store's part {:.2f} ({:.1f}); writing and syncing\n".format(*took["store.append"])
        + "as many bytes takes {:.2f} ({:.1f}), ".format(*took["file"])
        + f"so the store adds {ours['overhead of store.append']:.1f} of that, and "
        + f"{small['overhead of store.append']:.1f} to rows of {small['bytes of a row']:.0f} bytes, "
        + f"to which bare SQLite adds {small['overhead of sqlite']:.1f}.\n"
        + f"A `batch()` is {bulk['ratio']:.0f} times as fast as one by one where a sync takes 30 ms more "
        + f"({of_small['ratio']:.0f} with 64 features), and {batch['ratio']:.1f} times on this disk."
    )
