"""Records and galleries: they are read as written, and damaged files are refused."""

import json
import os
import re
import subprocess
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from zerobev.common.errors import InputError
from zerobev.evaluation.metrics import Counts
from zerobev.experiments.provenance import git_revision, origin
from zerobev.experiments.records import recorded
from zerobev.experiments.run_records import RunRecord, RunStore

from support.records import run_record

MAPS = np.random.default_rng(0).random((2, 8, 5, 5)) < 0.5


def record(key: str = "c-seed0-abc", counts: Counts | None = None) -> RunRecord:
    return run_record(
        key,
        counts or Counts(np.array([[1, 0], [2, 3]]), np.array([[4, 0], [2, 2**40]])),
        config={"train": {"steps": 3, "rate": 1e-3}, "bands": [0.0, 0.8]},
        origin={"revision": "0123456789ab", "versions": {"torch": "2"}},
        cost={"train_seconds": 1.5},
        history={"loss": [0.5, 0.25], "validation": [None, 0.1]},
    )


def test_record_comes_back_as_it_was(tmp_path):
    store = RunStore(tmp_path)
    assert store.find("c-seed0-abc") is None
    store.write(record(), MAPS)
    assert store.find("c-seed0-abc") == record()
    assert store.path("a.1-seed0-x").name == "a.1-seed0-x.json"
    files = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file())
    assert files == ["gallery/c-seed0-abc.npz", "records/c-seed0-abc.json"]
    assert len(store.path(record().key).read_text().splitlines()) == 2 + len(fields(RunRecord))  # a line per entry


def test_same_record_same_bytes(tmp_path):
    for name in "ab":
        RunStore(tmp_path / name).write(record(), MAPS)
    first, again = ([p.read_bytes() for p in sorted((tmp_path / n).rglob("*.*"))] for n in "ab")
    assert first == again


@given(arrays.arrays(bool, st.tuples(*(st.integers(1, n) for n in (3, 3, 19, 19)))))
@settings(max_examples=25)
def test_maps_of_any_size_come_back(tmp_path_factory, maps):
    store = RunStore(tmp_path_factory.mktemp("maps"))
    store.write(record(), maps)
    found = store.maps(record().key)
    assert found.dtype == bool and np.array_equal(found, maps)


def test_records_older_than_a_call_for_fresh_results_are_not_found(tmp_path, monkeypatch):
    store = RunStore(tmp_path)
    store.write(record(), MAPS)
    os.utime(store.path(record().key), (1000, 1000))
    for moment, found in (("999", True), ("1000", True), ("1001", False), ("0", True)):
        monkeypatch.setenv("ZEROBEV_FRESH", moment)
        assert (store.find(record().key) is not None) is found
    monkeypatch.setenv("ZEROBEV_FRESH", "1001")
    store.write(record(), MAPS)
    assert store.find(record().key) == record()


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: "[1, 2]",
        lambda text: "3",
        lambda text: text.replace('"row"', '"line"'),
        lambda text: text.replace('"seed": 0', '"seed": "0"'),
        lambda text: text.replace('"intersection"', '"overlap"'),
        lambda text: text.replace("[[1, 0]", "[[5, 0]"),  # more than the union
    ],
)
def test_a_file_that_is_no_record(tmp_path, damage):
    store = RunStore(tmp_path)
    store.write(record(), MAPS)
    path = store.path(record().key)
    path.write_text(damage(path.read_text()))
    with pytest.raises(InputError, match=r"c-seed0-abc\.json: expected a record, found .") as caught:
        store.find(record().key)
    assert "\n" not in str(caught.value)


def test_a_file_without_maps(tmp_path):
    store = RunStore(tmp_path)
    with pytest.raises(InputError, match=r"c-seed0-abc\.npz: expected the maps of a run, found ."):
        store.maps(record().key)
    store.write(record(), MAPS)
    store.write_gallery("views", rgb=np.zeros((2, 4, 4, 3), np.uint8), fov=np.eye(3, dtype=bool))
    found = store.gallery("views")
    assert found["rgb"].shape == (2, 4, 4, 3) and np.array_equal(found["fov"], np.eye(3, dtype=bool))
    assert store.gallery("other") is None
    for name, read in ((record().key, store.maps), ("views", store.gallery)):
        path = tmp_path / f"gallery/{name}.npz"
        whole = path.read_bytes()
        middle = len(whole) // 3
        for content in (b"", b"nonsense", whole[: len(whole) // 2], whole[:middle] + bytes(20) + whole[middle + 20 :]):
            path.write_bytes(content)
            with pytest.raises(InputError, match=rf"{name}\.npz: expected .*, found ."):
                read(name)


def test_an_interrupted_write_leaves_no_record(tmp_path):
    store = RunStore(tmp_path)
    with pytest.raises(TypeError):
        store.write(replace(record(), config={"model": object()}), MAPS)  # not JSON
    assert store.find(record().key) is None
    assert [path.name for path in tmp_path.rglob("*.*")] == ["c-seed0-abc.npz"]


def test_origin_holds_device_versions_and_revision_but_no_user_path():
    found = origin("cpu", git_revision())
    assert json.loads(json.dumps(found)) == found
    assert found["device"] == "cpu" and set(found["versions"]) > {"torch", "numpy"}
    assert found["revision"] and str(Path.home()) not in json.dumps(found)


def test_a_result_is_computed_once_for_each_configuration(tmp_path):
    path, made = tmp_path / "a.json", []

    def compute() -> dict[str, object]:
        made.append(len(made))
        return {"value": made[-1], "spread": (0.5, 1.5)}

    # types and order are those of JSON, computed or read
    first, second = ([*recorded(path, "a", {"weights": "x"}, compute, "cuda").items()] for _ in range(2))
    assert first == second == [("spread", [0.5, 1.5]), ("value", 0)]
    assert recorded(path, "a", {"weights": "y"}, compute, "cuda")["value"] == 1
    written = json.loads(path.read_text())
    assert made == [0, 1] and set(written) == {"key", "config", "origin", "cost", "result"}
    assert written["origin"]["device"] == "cuda"
    path.write_text("{}")
    with pytest.raises(InputError, match=r"a\.json: expected a record, found KeyError"):
        recorded(path, "a", {"weights": "y"}, compute, "cuda")


@dataclass(frozen=True)
class Then:
    steps: int
    rate: float = 0.5


@dataclass(frozen=True)
class Grown(Then):
    warmup: int = 0  # newer than the record


@dataclass(frozen=True)
class OtherDefault:
    steps: int
    rate: float = 0.25


def test_a_record_survives_a_new_field_but_not_a_new_default(tmp_path):
    path, made = tmp_path / "a.json", []

    def compute() -> dict[str, object]:
        made.append(0)
        return {}

    def computed(train: Then | OtherDefault) -> int:
        recorded(path, "a", {"train": train}, compute, "cpu")
        return len(made)

    assert computed(Then(3)) == computed(Grown(3)) == 1
    assert computed(Grown(3, warmup=1)) == 2
    assert computed(Then(3)) == 3
    assert computed(OtherDefault(3)) == 4  # the key is the same, the stored value is not


def test_a_revision_is_dirty_if_the_code_was_changed(tmp_path):
    def git(*arguments: str) -> None:
        settings = ("-c", "user.name=a", "-c", "user.email=a@b")
        subprocess.run(["git", *settings, *arguments], cwd=tmp_path, check=True, capture_output=True)

    code, report = tmp_path / "code", tmp_path / "report.json"
    code.mkdir()
    (code / "a.py").write_text("a = 1\n")
    assert git_revision(code) == "unknown"
    git("init")
    git("add", ".")
    git("commit", "-m", "a")
    clean = git_revision(code)
    assert re.fullmatch("[0-9a-f]{12}", clean)
    report.write_text("{}")  # as a reproduction does
    assert git_revision(code) == clean
    installed = tmp_path / ".venv/code"  # an environment in an ignored folder of the repository
    installed.mkdir(parents=True)
    (tmp_path / ".gitignore").write_text(".venv/\n")
    assert git_revision(installed) == "unknown"
    (code / "a.py").write_text("a = 2\n")
    assert git_revision(code) == f"{clean}-dirty"
