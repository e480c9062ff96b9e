"""The one error for bad input, and how commands show it."""

import errno
import sys
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


class InputError(ValueError):
    """Bad input from the user: the message names the file or argument, what was expected and what was found."""


class SetupError(InputError):
    """The machine lacks something that every input needs, so that the next input would fail as well."""


def attempt(work: Callable[[], T]) -> T | InputError:
    """The result of `work` on one input of many, or its failure, whatever it is, as an `InputError` of one line.

    Raised are only errors that every other input would meet, `SetupError` and a full disk, and what is no
    `Exception`, such as `KeyboardInterrupt`.
    """
    try:
        return work()
    except SetupError:
        raise
    except InputError as error:
        return InputError(str(error))  # without the traceback, which would keep the input in memory
    except Exception as error:
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            raise
        return InputError(" ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":"))


def run_command(main: Callable[[], None]) -> None:
    """Run a command's `main`; an `InputError` becomes one line on stderr and exit code 1, without a traceback.

    So does a full disk.
    """
    try:
        main()
    except InputError as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        sys.exit(f"error: {error.filename or 'disk'}: expected free disk, found none")
    except KeyboardInterrupt:
        sys.exit("interrupted")
