"""The one error for bad input, and how commands show it."""

import errno
import sys
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


class InputError(ValueError):
    """Bad input from the user: the message is "NAME: expected X, found Y", with a file or an argument as NAME."""


class SetupError(InputError):
    """The machine lacks something that every input needs: the next input would fail as well."""


def first_line(error: Exception) -> str:
    """First line of the message of an error; its type if it has no message."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def attempt(work: Callable[[], T]) -> T | InputError:
    """The result of `work` on one input of many, or any failure as an `InputError` of one line.

    Errors that every other input would meet are raised: `SetupError` and a full disk. So is anything other than an
    `Exception`, such as `KeyboardInterrupt`.
    """
    try:
        return work()
    except SetupError:
        raise
    except InputError as error:
        return InputError(str(error))  # without the traceback, which would keep the input in memory
    except Exception as error:  # one faulty input, whatever its error, does not end the work on the others
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            raise
        return InputError(" ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":"))


def run_command(main: Callable[[], None]) -> None:
    """Run a command's `main`; `InputError` and a full disk become one line on stderr and exit code 1, no traceback."""
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
