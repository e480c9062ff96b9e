"""Failures of one input among many, and errors of the machine."""

import errno
import gc
import pickle
import weakref

import pytest

from zerobev.common.errors import InputError, SetupError, attempt, first_line


def failing(error: BaseException) -> object:
    def work() -> None:
        raise error

    return attempt(work)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (InputError("a.glb: expected a home, found none"), "a.glb: expected a home, found none"),
        (IndexError("list index\n out of range"), "IndexError: list index out of range"),
        (AttributeError("'NoneType' has no attribute 'x'"), "AttributeError: 'NoneType' has no attribute 'x'"),
        (MemoryError(), "MemoryError"),
        (OSError(errno.EIO, "Input/output error"), "OSError: [Errno 5] Input/output error"),
        (RecursionError("too deep"), "RecursionError: too deep"),
    ],
)
def test_a_failure_of_one_input_becomes_an_input_error_of_one_line(error, message):
    found = failing(error)
    assert type(found) is InputError and str(found) == message
    assert str(pickle.loads(pickle.dumps(found))) == message  # as returned by a worker process


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), SystemExit(1), SetupError("no OpenGL"), OSError(errno.ENOSPC, "full")]
)
def test_failures_of_all_inputs_are_raised(error):
    with pytest.raises(type(error)) as raised:
        failing(error)
    assert raised.value is error


def test_the_result_is_returned():
    assert attempt(lambda: 3) == 3


def test_a_failure_does_not_keep_the_input_in_memory():
    class Home:
        pass

    def work() -> None:
        home = Home()
        alive.append(weakref.ref(home))
        raise InputError("broken")

    alive: list = []
    found = attempt(work)
    gc.collect()
    assert isinstance(found, InputError) and alive[0]() is None


def test_the_first_line_of_an_error_or_its_type():
    assert first_line(OSError("no such model\nsee the manual")) == "no such model"
    assert first_line(RuntimeError()) == "RuntimeError"
