"""The command line: every command says what it reads and writes, and is imported only when it is called."""

import re
import subprocess
import sys

import pytest

from zerobev import cli

from support.paths import ROOT


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_says_what_a_command_reads_and_writes(command, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main([command, "--help"])
    text = capsys.readouterr().out
    assert ended.value.code == 0 and f"usage: zerobev {command}" in text
    assert re.search("[Rr]ead", text) and re.search("[Ww]rite|[Pp]rint", text)


def test_the_list_of_commands_needs_no_heavy_library():
    found = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "zerobev", "--help"], cwd=ROOT, capture_output=True, text=True
    )
    assert found.returncode == 0 and all(f"  {command} " in found.stdout for command in cli.COMMANDS)
    imported = {line.rpartition("|")[2].strip() for line in found.stderr.splitlines()}
    assert not imported & {"torch", "numpy", "transformers", "pyrender"}


def test_an_unknown_command_and_bad_input_are_one_line(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["paint"])
    assert ended.value.code == 2 and "invalid choice: 'paint'" in capsys.readouterr().err.splitlines()[-1]
    with pytest.raises(SystemExit, match=r"^error: row: expected one of a\.1, .*, found 'z'$"):
        cli.main(["run", "--scale", "smoke", "--row", "z"])
    with pytest.raises(SystemExit, match=r"^error: setting 'train\.step=3': expected one of steps, .*, found 'step'$"):
        cli.main(["run", "--scale", "smoke", "--row", "c", "--set", "train.step=3"])


def test_a_missing_package_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setitem(cli.COMMANDS, "homes", ("missing_package", "write homes"))
    with pytest.raises(SystemExit, match=r"`zerobev homes` needs the package missing_package, .*install zerobev"):
        cli.main(["homes"])
