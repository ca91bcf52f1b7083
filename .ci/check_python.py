"""Ends with one sentence where Python is too old; the pip of such a Python lists every version that it cannot take."""

import sys

if sys.version_info < (3, 11):  # noqa: UP036  # any Python has to be able to read this
    sys.exit(
        "scroll-tactile needs Python 3.11 or newer, and python3 is "
        + sys.version.split()[0]
        + ": write the name of a newer one, such as python3.12, in place of each python3"
    )
