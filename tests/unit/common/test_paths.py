"""The folder of data and reports: for a checkout, for an installed package, and as chosen by the user."""

from argparse import Namespace
from pathlib import Path

import pytest

from zerobev.common import paths
from zerobev.common.errors import InputError
from zerobev.common.paths import zerobev_home
from zerobev.experiments import release
from zerobev.experiments.workspace import Workspace
from zerobev.report.notebooks import kernel_settings

from support.paths import ROOT


def test_a_checkout_contains_its_data_for_every_working_folder(monkeypatch, tmp_path):
    monkeypatch.delenv("ZEROBEV_HOME", raising=False)
    monkeypatch.chdir(tmp_path)
    assert zerobev_home() == ROOT
    assert Workspace("smoke").reports == ROOT / "reports/smoke"


def test_an_installed_package_writes_to_the_working_folder(monkeypatch, tmp_path):
    monkeypatch.delenv("ZEROBEV_HOME", raising=False)
    monkeypatch.setattr(paths, "PACKAGE_PARENT", tmp_path / "site-packages")
    monkeypatch.chdir(tmp_path)
    assert zerobev_home() == tmp_path
    assert Workspace("smoke").cache == tmp_path / ".cache"
    with pytest.raises(InputError, match="release: expected a checkout"):
        release.run(Namespace())  # would write beside the package


def test_the_users_choice_comes_first_and_reaches_kernels_as_an_absolute_path(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ZEROBEV_HOME", "data")
    chosen = tmp_path / "data"
    assert zerobev_home() == chosen
    workspace = Workspace("smoke")
    assert (workspace.cache, workspace.reports) == (chosen / ".cache", chosen / "reports/smoke")
    assert kernel_settings()["ZEROBEV_HOME"] == str(chosen)
    monkeypatch.setenv("ZEROBEV_HOME", "~/data")
    assert zerobev_home() == Path.home().resolve() / "data"


def test_a_file_is_refused(monkeypatch, tmp_path):
    (tmp_path / "data").touch()
    monkeypatch.setenv("ZEROBEV_HOME", str(tmp_path / "data"))
    with pytest.raises(InputError, match=r"ZEROBEV_HOME: expected a folder, found a file at .*data"):
        zerobev_home()
