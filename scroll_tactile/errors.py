"""The errors that scroll-tactile raises on purpose, grouped by what to do about them.

::

    ScrollTactileError (Exception)
    ├── InputError (ValueError)              what was passed in is wrong: correct it and call again
    │   ├── StreamError                      the readings cannot be made into a stream
    │   │   ├── EmptyStreamError             there are none: the sensor sent nothing
    │   │   ├── StreamTooShortError          touch for longer
    │   │   ├── NoContactError               no frame of a camera differs from its resting image: press the gel
    │   │   ├── ChannelCountError            they are not laid out as (time, channel) for this sensor
    │   │   ├── NotFiniteError               NaN or infinity: leave it out, repair it, or have it taken as missing
    │   │   └── ReadingsTypeError (TypeError)    they are not real numbers
    │   ├── MaterialError                    a material's name is not usable
    │   ├── DescriptionError                 what a material is said to be made of cannot be
    │   ├── AnnotationError                  a value or label of a touch cannot be kept, or its quantity not declared
    │   ├── UnknownMaterialError (KeyError)  a material that was never observed is asked for
    │   ├── ObservationError (KeyError)      an observation that is not there, or can no longer be retracted
    │   ├── RecordingError                   a file of readings is damaged, empty or of no known format
    │   │   └── FieldError                   it has no such topic or field: choose one that it has
    │   └── MissingLibraryError (ImportError)    an optional library is not installed: the message has the line
    ├── MismatchError                        two things that do not belong together: open the right one
    │   ├── SensorMismatchError              another sensor's stream or memory
    │   └── EmbeddingMismatchError           a memory made with another embedding
    ├── EmbeddingError                       an embedding broke its promise: mend it before it is used
    ├── LearnerError (AssertionError)        a learner of one's own making broke a promise: see `check_learner`
    ├── WeightsError                         a file of weights is damaged, another architecture's, or unreachable
    ├── DatasetError                         a data set's folder is not laid out as its publisher does
    ├── FineTuneError                        a fine-tune had to stop: the f* before it stays
    └── CapacityError (OverflowError)        exact sums would overflow: merge no more, start a new memory

    FactWarning (UserWarning)                what is odd about readings, and what to do; they are taken all the same
    └── RangeWarning                         they lie outside the sensor's range, or in a corner of it

A message says what was expected, what came, where, and what to do about it; it is written where it is raised.
"""

import re

# The wide forms count as well where Chinese or Japanese is written.
COMPUTED = re.compile(r"(^|;)(?=\s*'*[=+\-@\t\r＝＋－＠])")


def printable(text: str, keep: str = "") -> str:
    """Text with what does not print as Python's escapes: control characters, line ends, marks of direction, surrogates.

    Names and paths come from elsewhere, and must not drive the terminal that shows them. keep: what stays all the same.
    """
    if text.isprintable():
        return text
    return "".join(
        character if character.isprintable() or character in keep else character.encode("unicode_escape").decode()
        for character in text
    )


def plain_cell(text: str) -> str:
    """Text as a cell that no spreadsheet computes: an apostrophe before = + - @ where a cell may begin with it.

    It may behind a semicolon, too: there many countries' spreadsheets cut. One apostrophe less is the text again.
    """
    return COMPUTED.sub(r"\1'", text)


class ScrollTactileError(Exception):
    """Every error that scroll-tactile raises on purpose; catch it to catch them all.

    argument: the name of the argument that was wrong, or is to be given; several with blanks between; None where it is
    none of them. Where the message speaks of one it is written `name=`, which a command shows as its option.
    """

    def __init__(self, *message: object, argument: str | None = None) -> None:
        super().__init__(*message)
        self.argument = argument

    def __str__(self) -> str:
        return printable(super().__str__(), keep="\n")


class InputError(ScrollTactileError, ValueError):
    """What was passed in is wrong and nothing has changed: correct it and call again."""


class StreamError(InputError):
    """The readings cannot be made into a stream."""


class EmptyStreamError(StreamError):
    """There are no readings: the sensor sent nothing."""


class StreamTooShortError(StreamError):
    """There are too few readings, fewer than two: touch for longer."""


class NoContactError(StreamError):
    """No frame of a camera differs from the resting image: nothing was touched."""


class ChannelCountError(StreamError):
    """The readings are not laid out as (time, channel) with the channels of this sensor."""


class NotFiniteError(StreamError):
    """Values are NaN, infinite or masked, and the sensor takes none as missing, or all are."""


class ReadingsTypeError(StreamError, TypeError):
    """The readings are not real numbers."""


class MaterialError(InputError):
    """A material's name is not usable: no string, empty, too long, or with characters that do not print."""


class DescriptionError(InputError):
    """What a material is said to be made of cannot be: shares that do not sum to one, or a name that is none."""


class AnnotationError(InputError):
    """A touch's value or label cannot be kept: out of its range, undeclared, or another than the touch has already."""


class UnknownMaterialError(InputError, KeyError):
    """A material that was never observed is asked for."""

    def __str__(self) -> str:
        # KeyError would show the message as a quoted repr.
        return printable(Exception.__str__(self), keep="\n")


class ObservationError(InputError, KeyError):
    """An observation is not in the memory, was retracted already, or was compacted and can be retracted no more."""

    __str__ = UnknownMaterialError.__str__


class RecordingError(InputError):
    """A file of readings is not there, damaged, empty, ragged, or of no known format."""


class FieldError(RecordingError):
    """A recording has no such topic, field or column, or it holds no numbers; the message lists what there is."""


class MissingLibraryError(InputError, ImportError):
    """A library that comes with an extra is not installed, and the message has the line that does it; or is broken."""


class MismatchError(ScrollTactileError):
    """Two things were brought together that do not belong together."""


class SensorMismatchError(MismatchError):
    """A stream, or a memory, comes from another sensor."""


class EmbeddingMismatchError(MismatchError):
    """A memory was made with another embedding."""


class EmbeddingError(ScrollTactileError):
    """An embedding gave features that are not finite, not within its bound, or not of its dimension."""


class LearnerError(ScrollTactileError, AssertionError):
    """A learner of a user's own making does not keep what is promised of all."""


class WeightsError(ScrollTactileError):
    """A file of weights cannot be used: it is damaged, another architecture's, or unreachable."""


class DatasetError(ScrollTactileError):
    """A data set's folder is not laid out as its publisher does, or a file in it cannot be read."""


class FineTuneError(ScrollTactileError):
    """A fine-tune had to stop, with a loss that is not finite or without memory; the f* before it stays."""


class CapacityError(ScrollTactileError, OverflowError):
    """An exact sum would not fit its integers any more."""


class FactWarning(UserWarning):
    """Something is odd about readings that are taken all the same; the message says what to do about it.

    Said once a learner, and once a run over many files, with their number. argument: as of a `ScrollTactileError`.
    """

    def __init__(self, *message: object, argument: str | None = None) -> None:
        super().__init__(*message)
        self.argument = argument

    def __str__(self) -> str:
        return printable(super().__str__(), keep="\n")


class RangeWarning(FactWarning):
    """Many of a touch's values lie outside the range of the sensor, or all in a corner of it."""
