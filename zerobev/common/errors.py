"""The one error for bad input, and how commands show it."""

import errno
import sys
from collections.abc import Callable


class InputError(ValueError):
    """Bad input from the user: the message names the file or argument, what was expected and what was found."""


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
