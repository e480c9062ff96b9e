"""A photograph once: views, batches, threads, devices and precisions give the values of single calls."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

import zerobev
from zerobev.common.errors import InputError
from zerobev.config import SCALES
from zerobev.models import build
from zerobev.models.depth import DepthNet

from support.paths import ROOT

SMOKE = SCALES["smoke"]
CAMERA = zerobev.Camera(hfov_deg=90, height_m=1.2, pitch_deg=-10)
ROWS = ["a.2", "c", "d", "f", "f.r"]


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def projector(row: str) -> zerobev.Projector:
    """A projector of the smoke scale with random weights."""
    torch.manual_seed(0)
    network = None if row == "a.2" else build(row, SMOKE.camera, SMOKE.model).eval()
    return zerobev.Projector(row, SMOKE.camera, network, DepthNet(SMOKE.camera, SMOKE.model).eval())


def photograph(seed: int, shape: tuple[int, int] = (60, 80)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), dtype=np.uint8)


def modalities(shape: tuple[int, int] = (60, 80)) -> list:
    """One of each kind, of different numbers of images; one mask is empty."""
    rng = np.random.default_rng(7)
    masks = rng.random((3, *shape)) > 0.8
    masks[1] = False
    field = np.zeros((*shape, 2), np.float32)
    field[20:30, 20:40] = 5
    return [
        zerobev.Masks(masks),
        zerobev.Labels(rng.integers(0, 5, shape)),
        zerobev.Probabilities(rng.random(shape)),
        zerobev.Boxes([[5, 20, 40, 50], [30, 10, 70, 55]], ["a", "b"], [0.5, 1]),
        zerobev.Flow.of(field),
        zerobev.Flow.of(field, after=photograph(99, shape)),
    ]


def maps_of(result: zerobev.BevMap | zerobev.BevArrows) -> list[zerobev.BevMap]:
    return [result] if isinstance(result, zerobev.BevMap) else [result.starts, result.ends]


def assert_equal(one, other, atol: float = 0.0) -> None:
    assert type(one) is type(other)
    for ours, theirs in zip(maps_of(one), maps_of(other)):
        np.testing.assert_allclose(ours.values, theirs.values, atol=atol)
        np.testing.assert_allclose(ours.evidence, theirs.evidence, atol=10 * atol)
        np.testing.assert_array_equal(ours.fov, theirs.fov)
        assert ours.labels == theirs.labels and ours.camera == theirs.camera
        np.testing.assert_array_equal(ours.scores, theirs.scores)


@pytest.mark.parametrize("row", ROWS)
def test_a_view_projects_every_kind_and_computes_its_photograph_once(row):
    model, calls = projector(row), []
    expected = [model.project(photograph(0), kind, CAMERA) for kind in modalities()]
    for module in (model.estimator, *([] if model.network is None else [model.network.backbone])):
        module.register_forward_hook(lambda module, *_: calls.append(type(module).__name__))
    view = model.view(photograph(0), CAMERA)
    once = sorted(calls)
    assert once == ["DepthNet"] + ["RgbEncoder"] * (row != "a.2")
    for kind, one in zip(modalities()[:-1], expected):
        assert_equal(view.project(kind), one)
    assert sorted(calls) == once  # also by the number of calls
    assert_equal(view.project(modalities()[-1]), expected[-1])
    assert sorted(calls) == sorted(2 * once)  # the second photograph of flow
    np.testing.assert_array_equal(view.depth, model.depth(photograph(0), CAMERA))


def test_a_view_has_the_camera_and_the_depth_of_its_photograph():
    model = projector("d")
    depth = np.full((60, 80), 2.0, np.float32)
    view = model.view(photograph(0), CAMERA, depth)
    mask = modalities()[0]
    assert_equal(view.project(mask), model.project(photograph(0), mask, CAMERA, depth))
    assert np.abs(view.project(mask).values - model.project(photograph(0), mask, CAMERA).values).max() > 1e-3
    assert view.project(mask.values, names=["x", "y", "z"]).labels == ("x", "y", "z")
    with pytest.raises(InputError, match=r"names: expected names, found a camera: .* needs its own view"):
        view.project(mask, zerobev.Camera(60))
    with pytest.raises(InputError, match=r"modality: expected \(60, 80\) or \(K, 60, 80\) of bool, found \(80, 60\)"):
        view.project(mask.values[0].T)
    with pytest.raises(InputError, match="depth: expected none for Flow, found depth of one of two photographs"):
        view.project(modalities()[-1])
    with pytest.raises(InputError, match=r"camera: expected a zerobev\.Camera, found 90"):
        model.view(photograph(0), 90)
    with pytest.raises(InputError, match=r"rgb: expected \(H, W, 3\), found \(\)"):
        model.view(None)


@pytest.mark.parametrize("row", ["a.2", "d", "f"])
def test_a_batch_gives_the_maps_of_single_calls_in_one_pass(row):
    """Photographs of three sizes, kinds with different numbers of images, one with two photographs."""
    model, calls = projector(row), []
    shapes = [(60, 80), (32, 32), (60, 80), (90, 40), (60, 80), (60, 80)]
    images = [photograph(seed, shape) for seed, shape in enumerate(shapes)]
    kinds = [modalities(shape)[n] for n, shape in enumerate(shapes)]
    kinds[1] = zerobev.Masks(np.zeros((32, 32), bool))
    expected = [model.project(image, kind, CAMERA) for image, kind in zip(images, kinds)]
    if model.network is not None:
        model.network.backbone.register_forward_hook(lambda *_: calls.append(1))
    for found, one in zip(model.project_batch(images, kinds, CAMERA), expected, strict=True):
        assert_equal(found, one, atol=2e-5)
    assert len(calls) == (model.network is not None)


def test_a_batch_has_a_modality_per_image():
    model = projector("a.2")
    for images, kinds in (([photograph(0)], []), ([], [])):
        with pytest.raises(InputError, match=f"modalities: expected one per image, .*found 0 for {len(images)} images"):
            model.project_batch(images, kinds)


@pytest.mark.parametrize("row", ["d", "f.r"])
def test_threads_get_the_values_of_one_thread(row):
    model, kinds = projector(row), [kind for kind in modalities() if not isinstance(kind, zerobev.Flow)]
    view = model.view(photograph(0), CAMERA)
    jobs = [
        *((model.project, photograph(seed), kind, CAMERA) for seed in range(2) for kind in kinds),
        *((view.project, kind) for kind in kinds for _ in range(2)),
    ]
    expected = [function(*arguments) for function, *arguments in jobs]
    with ThreadPoolExecutor(8) as pool:
        for one, future in zip(expected, [pool.submit(*job) for job in jobs]):
            assert_equal(future.result(), one)


@pytest.mark.parametrize("row", ROWS)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_precision_is_a_copy_s_and_changes_maps_by_rounding_alone(row, dtype):
    model = projector(row)
    before = model.project(photograph(0), modalities()[0], CAMERA)
    half = model.to("cpu", dtype=dtype)
    assert (half.dtype, model.dtype) == (dtype, torch.float32) and half.device.type == "cpu"
    after = half.project(photograph(0), modalities()[0], CAMERA)
    assert after.values.dtype == after.evidence.dtype == half.depth(photograph(0)).dtype == np.float32
    step = torch.finfo(dtype).eps
    depth = model.depth(photograph(0))
    assert 0 < np.abs(half.depth(photograph(0)) - depth).mean() < step * depth.mean()
    assert np.abs(after.values - before.values).mean() < 3 * step
    assert_equal(model.project(photograph(0), modalities()[0], CAMERA), before)


def test_devices_and_precisions_that_cannot_compute_are_refused():
    model = projector("c")
    with pytest.raises(InputError, match=r"dtype: expected one of torch\.float32, .*, found torch\.float64"):
        model.to(dtype=torch.float64)
    with pytest.raises(InputError, match="device: expected one that torch can use here, found 'gpu': "):
        model.to("gpu")
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="device: expected one that torch can use here, found 'cuda': "):
            model.to("cuda")


@pytest.mark.slow
def test_the_type_of_a_result_is_that_of_the_kind(tmp_path: Path):
    """mypy knows each result, without a cast."""
    (tmp_path / "use.py").write_text(
        """
from typing import assert_type
import numpy as np
import zerobev
model = zerobev.load()
def use(rgb: np.ndarray, masks: zerobev.Masks, boxes: zerobev.Boxes, flow: zerobev.Flow) -> None:
    view = model.view(rgb)
    assert_type(view.project(flow), zerobev.BevArrows)
    assert_type(model.project(rgb, flow), zerobev.BevArrows)
    assert_type(view.project(masks), zerobev.BevMap)
    assert_type(model.project(rgb, boxes), zerobev.BevMap)
    assert_type(view.project(rgb > 0.5), zerobev.BevMap)
    assert_type(model.project_batch([rgb], [boxes]), list[zerobev.BevMap])
    assert_type(model.project_batch([rgb], [flow]), list[zerobev.BevArrows])
"""
    )
    command = [sys.executable, "-m", "mypy", "--config-file", ROOT / "pyproject.toml", tmp_path / "use.py"]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout
