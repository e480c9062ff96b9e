"""The one error for bad input, and how commands show it."""

import sys
from collections.abc import Callable


class InputError(ValueError):
    """Bad input from the user: the message names the file or argument, what was expected and what was found."""


def run_command(main: Callable[[], None]) -> None:
    """Run a command's `main`; an `InputError` becomes one line on stderr and exit code 1, without a traceback."""
    try:
        main()
    except InputError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted")
