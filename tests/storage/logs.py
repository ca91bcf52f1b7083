"""Logs for the tests, and what is in them."""

from contextlib import contextmanager

from scroll_tactile_store.framing import FRAME_BYTES
from scroll_tactile_store.log import Log, create_log, refuse

HEADER = b'{"of":"a test"}'
KIND = 2


def payload(index, size=None):
    """Bytes that tell their frame; some are larger than a sector, and one is empty."""
    size = (0, 30, 700, 90)[index % 4] if size is None else size
    return (b"%05d" % index * (size // 5 + 1))[:size]


# Rows in batches of one, two and three.
BATCHES = [[payload(0)], [payload(1), payload(2)], [payload(3)], [payload(4), payload(5), payload(6)], [payload(7)]]


def build(path, batches=BATCHES, header=HEADER):
    create_log(path, header)
    with writing(path) as log:
        for batch in batches:
            append(log, batch)
    return path


def to_write(path):
    """A log made ready to append to."""
    log = Log(path, write=True)
    try:
        rest(log)
        log.prepare()
    except BaseException:
        log.close()
        raise
    return log


@contextmanager
def writing(path):
    log = to_write(path)
    try:
        yield log
    finally:
        log.close(trim=True)


def append(log, batch):
    frames = [log.stage(KIND, each) for each in batch]
    log.commit()
    return frames


def rest(log):
    """The payloads of the batches that a reader has not yielded yet."""
    return [[log.read(frame.offset, frame.size) for frame in batch] for batch in log.scan(refuse)]


def read(path):
    with Log(path) as log:
        return rest(log)


def ends(path):
    """The frames as (batch, begin, end), the commit frames among them, and where each batch ends."""
    frames, commits = [], []
    with Log(path) as log:
        begin = log.place.offset
        for number, batch in enumerate(log.scan(refuse)):
            frames += [(number, frame.offset, frame.end) for frame in batch]
            frames.append((number, log.place.offset - FRAME_BYTES, log.place.offset))
            commits.append(log.place.offset)
    return begin, frames, commits


def names(folder):
    return sorted(path.name for path in folder.iterdir())
