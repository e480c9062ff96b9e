"""`zerobev.load().project`: against the networks, against a closed form, and as a command."""

import argparse
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors import safe_open

import zerobev
from zerobev.common.errors import InputError
from zerobev.config import SCALES, CameraConfig
from zerobev.experiments.depth_pretraining import DepthPretraining
from zerobev.experiments.release import SCALE, halve, sources
from zerobev.experiments.workspace import Workspace
from zerobev.geometry.projection import inverse_project
from zerobev.inference.modality import BinaryImages
from zerobev.inference.probabilities import LEVELS
from zerobev.inference.project import add_arguments, run
from zerobev.inference.shipped_weights import DEPTH, FOLDER, ROWS, run_of, shipped
from zerobev.models import build, load_model
from zerobev.models.depth import DepthNet

from support.paths import ROOT

SIDE = SCALES[SCALE].camera.fpv_px
CAMERA = CameraConfig(fpv_px=SIDE, bev_px=40)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def models() -> dict[str, zerobev.Projector]:
    return {row: zerobev.load(row) for row in ("a.2", *ROWS)}


@pytest.fixture(scope="module")
def rgb() -> np.ndarray:
    """A floor, a wall, and a dark object between them."""
    image = np.full((SIDE, SIDE, 3), (200, 190, 170), np.uint8)
    image[SIDE // 2 + 8 :] = (120, 90, 60)
    image[SIDE // 2 - 4 : SIDE // 2 + 14, 20:40] = (40, 50, 60)
    return image


@pytest.fixture(scope="module")
def masks() -> np.ndarray:
    images = np.zeros((3, SIDE, SIDE), bool)
    images[0, SIDE // 2 + 8 :] = True
    images[1, SIDE // 2 - 4 : SIDE // 2 + 14, 20:40] = True
    return images  # the last one is empty


def flat(depth_m: float) -> zerobev.Projector:
    """P^-1 with the same depth everywhere."""
    return zerobev.Projector("a.2", CAMERA, None, lambda rgb: torch.full((1, 1, SIDE, SIDE), depth_m))


@pytest.mark.slow
def test_the_package_imports_torch_only_on_use():
    code = "import sys, zerobev; assert 'torch' not in sys.modules; assert zerobev.load and 'torch' in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
    with pytest.raises(AttributeError, match="no attribute 'unload'"):
        _ = zerobev.unload


# --- the shipped weights -----------------------------------------------------------------------------------------


def test_the_weights_are_small_and_come_from_the_recorded_runs():
    files = {path.stem: path for path in FOLDER.glob("*")}
    assert set(files) == {*ROWS, DEPTH} and sum(path.stat().st_size for path in files.values()) < 30e6
    assert {name: run_of(path) for name, path in files.items()} == {name: one.key for name, one in sources().items()}
    for row in ROWS:
        assert (ROOT / "reports" / SCALE / "records" / f"{run_of(files[row])}.json").exists()
    assert json.loads((ROOT / "reports" / SCALE / "depth.json").read_text())["key"] == run_of(files[DEPTH])


def test_half_precision_only_rounds():
    source = DepthPretraining(Workspace(SCALE))
    if source.recorded() is None:
        pytest.skip(
            "weights in full precision are not in this checkout; `zerobev run --scale deploy --row a.2` trains them"
        )
    recorded = DepthNet.load(source.weights).state_dict()
    for name, tensor in DepthNet.load(shipped(DEPTH)).state_dict().items():
        assert tensor.dtype == recorded[name].dtype
        torch.testing.assert_close(tensor, recorded[name], rtol=2**-10, atol=1e-7)


def test_weights_beyond_half_precision_are_refused(tmp_path):
    torch.manual_seed(0)
    model = build("c", SCALES["smoke"].camera, SCALES["smoke"].model)
    model.save(tmp_path / "whole.safetensors")
    halve(tmp_path / "whole.safetensors", tmp_path / "half.safetensors", "run-7")
    assert run_of(tmp_path / "half.safetensors") == "run-7"
    again = load_model(tmp_path / "half.safetensors").state_dict()
    assert all(torch.equal(again[k], t.half().to(t.dtype)) for k, t in model.state_dict().items())
    with safe_open(tmp_path / "half.safetensors", framework="pt") as file:
        assert {file.get_tensor(name).dtype for name in file.keys()} == {torch.float16, torch.int64}  # noqa: SIM118
    with torch.no_grad():
        next(iter(model.parameters()))[0] = 1e6
    model.save(tmp_path / "whole.safetensors")
    with pytest.raises(InputError, match="expected weights within half precision"):
        halve(tmp_path / "whole.safetensors", tmp_path / "half.safetensors", "run-7")


@pytest.mark.parametrize(
    ("source", "message"),
    [("z", "source: expected one of a.2, c, .*found 'z'"), (shipped(DEPTH), "expected a zero-shot network")],
)
def test_only_zero_shot_networks_are_loaded(source, message):
    with pytest.raises(InputError, match=message):
        zerobev.load(source)


def test_a_network_of_another_camera_needs_its_own_depth(tmp_path):
    smoke = SCALES["smoke"]
    build("c", smoke.camera, smoke.model).save(tmp_path / "own.safetensors")
    with pytest.raises(InputError, match="estimator: expected a depth estimator for images of 32 px"):
        zerobev.load(tmp_path / "own.safetensors")
    own = zerobev.load(tmp_path / "own.safetensors", DepthNet(smoke.camera, smoke.model).eval())
    assert own.project(np.zeros((50, 60, 3)), np.ones((50, 60), bool)).maps.shape == (1, 20, 20)


# --- projection ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("row", ROWS)
def test_a_projector_gives_the_output_of_its_network(row, models, rgb, masks):
    bev = models[row].project(rgb, masks, names=["floor", "thing", "nothing"])
    batch = torch.from_numpy(rgb / np.float32(255)).permute(2, 0, 1)[None]
    with torch.inference_mode():
        depth = DepthNet.load(shipped(DEPTH))(batch)
        logits = load_model(shipped(row))(batch, torch.from_numpy(masks).float()[None], depth).zero_logits[0]
    np.testing.assert_allclose(bev.values[:2], logits[:2].sigmoid(), atol=1e-4)
    np.testing.assert_allclose(bev.evidence[:2], (logits[:2] - logits[2]).clamp(min=0), atol=1e-3)
    assert not bev.values[2].any() and not bev.maps[2].any()  # empty for every output of the network
    assert bev.labels == ("floor", "thing", "nothing") and bev.maps[0].any()
    assert not (bev.maps & ~bev.fov).any()


@pytest.mark.parametrize("row", ["a.2", *ROWS])
def test_size_and_type_of_the_photograph_have_no_effect(row, models, rgb, masks):
    bev = models[row].project(rgb, masks)
    large = np.repeat(np.repeat(rgb, 5, 0), 5, 1).astype(np.float64) / 255
    again = models[row].project(large, np.repeat(np.repeat(masks, 5, 1), 5, 2))
    np.testing.assert_allclose(again.values, bev.values, atol=1e-3)


def test_a_label_map_equals_a_stack_of_masks(models, rgb, masks):
    labels = np.where(masks[1], 4, np.where(masks[0], 1, -1)).astype(np.int16)
    bev = models[ROWS[0]].project(rgb, labels, names={1: "floor", 4: "thing"})
    stack = models[ROWS[0]].project(rgb, np.stack([labels == 1, labels == 4]))
    assert bev.labels == ("floor", "thing")
    np.testing.assert_allclose(bev.values, stack.values, atol=1e-5)


def test_values_are_projected_level_by_level(rgb):
    values = np.random.default_rng(0).random((SIDE, SIDE)).astype(np.float32)
    bev = flat(2.0).project(rgb, values)
    rounded = torch.from_numpy(np.floor(values * LEVELS + 0.5) / LEVELS)[None, None]
    expected = inverse_project(rounded.float(), torch.full((1, 1, SIDE, SIDE), 2.0), CAMERA)[0]
    np.testing.assert_allclose(bev.values, expected, atol=1e-6)


def test_parts_outside_a_narrow_photograph_are_outside_the_field_of_view(rgb):
    full, narrow = (
        flat(2.0).project(rgb, np.ones((SIDE, SIDE), bool), camera=zerobev.Camera(hfov)) for hfov in (79, 40)
    )
    for bev, hfov in ((full, 79), (narrow, 40)):
        half_m = 2 * np.tan(np.radians(hfov / 2))
        assert bev.maps.any() and bev.maps.sum() == pytest.approx(2 * half_m / 0.125, abs=2)
        assert (bev.fov.any(axis=0) == bev.maps[0].any(axis=0)).all()


def test_boxes_have_label_score_and_position(rgb):
    x, y = SIDE // 2, SIDE // 2 - 4
    corners = np.array([[x - 2.0, y, x + 2, y + 8], [x + 12, y, x + 16, y + 8]])
    boxes = zerobev.Boxes(corners, ("a", "b"), np.array([0.9, 0.4]))
    table = flat(3.0).project(rgb, boxes).footprints()
    assert table["label"].tolist() == ["a", "b"] and table["score"].tolist() == [0.9, 0.4]
    np.testing.assert_allclose(table["right_m"], [0, 14 / CAMERA.focal_px * 3], atol=0.07)
    np.testing.assert_allclose(table["forward_m"], 3.0625)


def test_an_arrow_is_from_the_disc_at_its_start_to_the_disc_at_its_end(rgb):
    field = np.zeros((SIDE, SIDE, 2), np.float32)
    field[30:34, 10:13] = (30, 0)
    arrows = flat(2.0).project(rgb, zerobev.Flow.of(field))
    moved_m = 30 / CAMERA.focal_px * 2
    vector = arrows.end_m - arrows.start_m
    assert len(vector) == 1 and vector[0] == pytest.approx([moved_m, 0], abs=0.13)
    assert arrows.show().get_title() == ""
    nearer = zerobev.Projector("a.2", CAMERA, None, lambda rgb: torch.full((1, 1, SIDE, SIDE), 1 + float(rgb.max())))
    flow = zerobev.Flow.of(field, after=np.zeros_like(rgb))  # the second frame is dark: its depth is 1 m
    assert nearer.project(rgb / 255 / (200 / 255), flow).end_m[0, 1] == pytest.approx(1.0625)


def test_the_kind_decides_the_result(models, rgb, masks, tmp_path):
    """A new kind needs only the two methods; photographs may be files."""

    class Column:
        def layers(self, shape):
            images = np.zeros((1, *shape), bool)
            images[0, :, 30] = True
            return (BinaryImages(("column",), images),)

        def result(self, maps):
            return zerobev.BevArrows(maps[0], maps[0])

    arrows = flat(2.0).project(rgb, Column())
    np.testing.assert_array_equal(arrows.start_m, arrows.end_m)
    Image.fromarray(rgb).save(tmp_path / "photo.png")
    expected = models["a.2"].project(rgb, masks).values
    for photograph in (tmp_path / "photo.png", (tmp_path / "photo.png").read_bytes(), Image.fromarray(rgb)):
        np.testing.assert_array_equal(models["a.2"].project(photograph, masks).values, expected)
    bev = models["a.2"].project(rgb, zerobev.Masks(masks.astype(np.uint8) * 255), names=["x", "y", "z"])
    np.testing.assert_array_equal(bev.values, expected)
    assert bev.labels == ("x", "y", "z")
    with pytest.raises(InputError, match="names: expected none for Boxes, which contains its names"):
        models["a.2"].project(rgb, zerobev.Boxes([[1, 2, 30, 40]], ["a"], [1]), names=["b"])


class Coarse:
    """An estimator of depth from brightness that records its inputs."""

    side_px = 256

    def __init__(self, factor: float = 5.0):
        self.factor, self.seen = factor, []

    def __call__(self, rgb: torch.Tensor) -> torch.Tensor:
        self.seen.append(rgb)
        return rgb.mean(dim=1, keepdim=True) * self.factor


@pytest.mark.parametrize(("side", "seen"), [(1000, 256), (150, 150), (SIDE, SIDE), (100, SIDE)])
def test_the_input_of_an_estimator_has_its_size_up_to_the_photograph_s(side, seen):
    estimator = Coarse()
    row, column = np.mgrid[:side, :side] / side
    photograph = np.stack([0.2 + 0.3 * row, 0.2 + 0.3 * column, 0.4 + 0 * row], axis=-1)
    depth = zerobev.Projector("a.2", CAMERA, None, estimator).depth(photograph)
    assert estimator.seen[0].shape == (1, 3, seen, seen)
    grid = (np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE
    np.testing.assert_allclose(depth, (0.8 + 0.3 * grid.sum(axis=0)) / 3 * 5, atol=0.02)


# --- depth of a sensor --------------------------------------------------------------------------------------------


def test_measured_depth_replaces_the_estimate_and_scales_it_where_it_is_missing():
    """The estimate is 2 m everywhere. A sensor measures 3 m in the left half; the rest is then 2 m * 3 / 2."""
    measured = np.full((SIDE, SIDE), np.nan, np.float32)
    measured[:, : SIDE // 2] = 3.0
    measured[:8] = 0.0
    rgb = np.zeros((SIDE, SIDE, 3), np.uint8)
    model = flat(2.0)
    np.testing.assert_allclose(model.depth(rgb), 2.0)
    np.testing.assert_allclose(model.depth(rgb, depth=measured), 3.0, rtol=1e-6)
    few = np.zeros((SIDE, SIDE), np.float32)
    few[0, :5] = 3.0  # too few values for a scale
    np.testing.assert_allclose(model.depth(rgb, depth=few), np.where(few > 0, 3.0, 2.0))


def test_the_map_follows_measured_depth(models, rgb):
    """A wall at 1.5 m or at 4 m: P^-1 marks the row of cells at its depth."""
    mask = np.ones((SIDE, SIDE), bool)
    for metres in (1.5, 4.0):
        bev = models["a.2"].project(rgb, mask, depth=np.full((SIDE, SIDE), metres))
        rows = np.flatnonzero(bev.maps[0].any(axis=1))
        assert rows.tolist() == [CAMERA.bev_px - 1 - int(metres / CAMERA.cell_m)]
    near, far = (models["d"].project(rgb, mask, depth=np.full((SIDE, SIDE), z)).values for z in (1.5, 4.0))
    assert np.abs(near - far).max() > 0.1  # the residual network reads it


def test_a_residual_network_gets_a_mask_of_the_measured_pixels(rgb):
    """The left half is measured at 2 m; the estimate is 2 m everywhere, so P^-1 of the mask is that of the half."""
    torch.manual_seed(0)
    network = build("d", CAMERA, replace(SCALES["smoke"].model, seen=True, measured=True)).eval()
    model = zerobev.Projector("d", CAMERA, network, lambda rgb: torch.full((len(rgb), 1, SIDE, SIDE), 2.0))
    left = np.zeros((SIDE, SIDE), np.float32)
    left[:, : SIDE // 2] = 2.0
    views = [model.view(rgb), model.view(rgb, depth=left)]
    cells, seen, measured = zip(*(view.features[:3] for view in views))
    assert torch.equal(cells[0], cells[1]) and torch.equal(seen[0], seen[1]) and not measured[0].any()
    expected = inverse_project(torch.from_numpy(left)[None, None].sign(), torch.full((1, 1, SIDE, SIDE), 2.0), CAMERA)
    assert expected.any() and torch.equal(measured[1], expected)


def test_a_limit_on_heights_follows_the_camera_s_height():
    """A wall 2 m away, seen from 0.3 m and 1.8 m: pixels below 2 m above the floor count, others do not."""
    for height in (0.3, 0.88, 1.8):
        rows = (np.arange(SIDE) + 0.5 - SIDE / 2) / CAMERA.focal_px * 2.0  # metres below the pinhole
        for mask, expected in ((height - rows < 1.99, True), (height - rows > 2.01, False)):
            image = np.repeat(mask[:, None], SIDE, axis=1)
            bev = flat(2.0).project(np.zeros((SIDE, SIDE, 3), np.uint8), image, zerobev.Camera(height_m=height))
            assert bev.maps.any() == (expected and image.any())


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (np.ones((3, 3)), rf"expected the photograph's size \({SIDE}, {SIDE}\), found \(3, 3\)"),
        (np.full((SIDE, SIDE), 2000, np.uint16), "expected floating point, metres, found uint16; millimetres"),
        (np.full((SIDE, SIDE), 2000.0), "expected metres, found a median of 2000: millimetres?"),
        (np.full((SIDE, SIDE), -1.0), "found infinity or less than 0"),
        (np.full((SIDE, SIDE), np.inf), "found infinity or less than 0"),
    ],
)
def test_depth_of_a_sensor_is_checked(depth, message, rgb):
    with pytest.raises(InputError, match=f"depth: .*{message}"):
        flat(2.0).project(rgb, np.ones((SIDE, SIDE), bool), depth=depth)


@pytest.mark.parametrize(
    ("estimate", "message"),
    [
        (lambda rgb: torch.full((1, 1, SIDE, SIDE), 2300.0), "expected depth in metres, found a median of 2300"),
        (lambda rgb: torch.full((1, 1, SIDE, SIDE), -1.0), "expected finite depth from 0 up"),
        (lambda rgb: torch.full((1, 1, SIDE, SIDE), float("nan")), "expected finite depth from 0 up"),
        (
            lambda rgb: torch.ones(1, SIDE, SIDE),
            rf"expected depth \(1, 1, {SIDE}, {SIDE}\), found \(1, {SIDE}, {SIDE}\)",
        ),
    ],
)
def test_depth_that_is_not_in_metres_is_refused(estimate, message, rgb):
    with pytest.raises(InputError, match=f"estimator: {message}"):
        zerobev.Projector("a.2", CAMERA, None, estimate).project(rgb, np.ones((SIDE, SIDE), bool))


def test_depth_is_zero_outside_the_photograph(models, rgb):
    depth = models["a.2"].depth(rgb, zerobev.Camera(40))
    assert depth.shape == (SIDE, SIDE) and depth[SIDE // 2, SIDE // 2] > 0 and not depth[0].any()


@pytest.mark.parametrize(
    ("photograph", "message"),
    [
        (np.zeros((4, 4)), r"rgb: expected \(H, W, 3\), found \(4, 4\)"),
        (np.zeros((4, 4, 4), np.uint8), r"found \(4, 4, 4\)"),
        (np.zeros((0, 4, 3), np.uint8), r"found \(0, 4, 3\)"),
        (np.zeros((4, 4, 3), np.int32), r"rgb: expected uint8 or floating point, found int32"),
        (np.full((4, 4, 3), 255.0), r"rgb: expected values in \[0, 1\], found 255 to 255"),
        (np.full((4, 4, 3), np.nan), r"rgb: expected values in \[0, 1\], found NaN"),
    ],
)
def test_invalid_photographs_are_refused(photograph, message):
    with pytest.raises(InputError, match=message):
        flat(1.0).project(photograph, np.ones((4, 4), bool))


def test_masks_of_another_size_and_no_boxes_are_refused(rgb):
    expected = rf"modality: expected \({SIDE}, {SIDE}\) or \(K, {SIDE}, {SIDE}\) of bool, found \(32, 32\)"
    with pytest.raises(InputError, match=expected):
        flat(1.0).project(rgb, np.ones((32, 32), bool))
    with pytest.raises(InputError, match="modality: expected an array, found list"):
        flat(1.0).project(rgb, [[True], [True, False]])
    with pytest.raises(InputError, match=r"found \(32, 32\): resize it to the photograph, by nearest neighbour"):
        flat(1.0).project(rgb, zerobev.Masks(np.ones((32, 32), bool)))
    with pytest.raises(InputError, match="at least one box"):
        flat(1.0).project(rgb, zerobev.Boxes(np.zeros((0, 4)), (), np.zeros(0)))


# --- the command --------------------------------------------------------------------------------------------------


def command(*arguments: object) -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    run(parser.parse_args(list(map(str, arguments))))


def test_the_command_writes_what_project_returns(models, rgb, masks, tmp_path, capsys):
    photo, floor, thing, out = (tmp_path / name for name in ("photo.png", "floor.png", "thing.png", "map.png"))
    Image.fromarray(rgb).save(photo)
    for path, mask in ((floor, masks[0]), (thing, masks[1])):
        Image.fromarray(mask.astype(np.uint8)).save(path)
    command(photo, "--masks", floor, thing, "--hfov", 85, "--out", out, "--row", ROWS[0])
    expected = models[ROWS[0]].project(rgb, masks[:2], camera=zerobev.Camera(85))
    with np.load(out.with_suffix(".npz")) as file:
        np.testing.assert_allclose(file["values"], expected.values, atol=1e-4)
        assert file["labels"].tolist() == ["floor", "thing"]
    picture = np.asarray(Image.open(out))
    assert picture.shape[1] > 1.5 * picture.shape[0] and picture.std() > 5
    assert "floor" in capsys.readouterr().out

    (tmp_path / "boxes.csv").write_text("xmin,ymin,xmax,ymax,label,score\n20,28,40,46,thing,0.8\n")
    command(photo, "--boxes", tmp_path / "boxes.csv", "--out", out, "--row", "a.2")
    assert "0.8" in capsys.readouterr().out

    labels = np.where(masks[1], 255, np.where(masks[0], 1, 0)).astype(np.uint8)
    Image.fromarray(labels).save(tmp_path / "labels.png")
    for ignore, expected in (("255", ["0", "1"]), ("none", ["0", "1", "255"])):
        command(photo, "--labels", tmp_path / "labels.png", "--ignore", ignore, "--out", out, "--row", "a.2")
        with np.load(out.with_suffix(".npz")) as file:
            assert file["labels"].tolist() == expected


def test_the_command_takes_a_camera_and_the_depth_of_a_sensor(models, rgb, masks, tmp_path):
    photo, mask, out = (tmp_path / name for name in ("photo.png", "floor.png", "map.png"))
    Image.fromarray(rgb).save(photo)
    Image.fromarray(masks[0].astype(np.uint8)).save(mask)
    depth = np.full((SIDE, SIDE), 2.5, np.float32)
    lens = (0.7 * SIDE, 0.78 * SIDE, SIDE / 2 - 2, SIDE / 2 + 1)
    np.save(tmp_path / "depth.npy", depth)
    options = ("--lens", *lens, "--height", 1.2, "--pitch", -15, "--roll", 3)
    command(photo, "--masks", mask, *options, "--depth", tmp_path / "depth.npy", "--out", out, "--row", "a.2")
    camera = zerobev.Camera(**dict(zip(("fx", "fy", "cx", "cy"), lens)), height_m=1.2, pitch_deg=-15, roll_deg=3)
    expected = models["a.2"].project(rgb, masks[0], camera, depth)
    assert expected.maps.any()
    with np.load(out.with_suffix(".npz")) as file:
        np.testing.assert_array_equal(file["values"], expected.values)
    (tmp_path / "bad.npy").write_text("nothing")
    with pytest.raises(InputError, match=r"bad\.npy: expected an array in NumPy's format"):
        command(photo, "--masks", mask, "--depth", tmp_path / "bad.npy", "--out", out)


def test_the_command_names_the_fault(rgb, tmp_path):
    photo, text, voc, small = (tmp_path / f"{name}.png" for name in ("photo", "text", "voc", "small"))
    Image.fromarray(np.array([[0, 7, 255]] * 3, np.uint8)).save(voc)
    Image.new("1", (4, 4)).save(small)
    Image.fromarray(rgb).save(photo)
    text.write_text("no image")
    for arguments, message in (
        ((text, "--masks", photo, "--out", tmp_path / "a.png"), "text.png: expected an image"),
        ((photo, "--labels", photo, "--out", tmp_path / "a.png"), "expected a label map of one channel"),
        ((photo, "--labels", voc, "--out", tmp_path / "a.png"), "expected a choice for label 255, .*--ignore none"),
        ((photo, "--labels", voc, "--ignore", "x", "--out", tmp_path / "a.png"), "--ignore: expected a label or none"),
        ((photo, "--masks", photo, "--ignore", "0", "--out", tmp_path / "a.png"), "--ignore: expected beside --labels"),
        (
            (photo, "--masks", small, "--out", tmp_path / "a.png"),
            "small.png: expected the photograph's size",
        ),
        ((photo, "--masks", photo, "--out", tmp_path / "a.jpg"), "ends in .png"),
        ((tmp_path / "none.png", "--masks", photo, "--out", tmp_path / "a.png"), "none.png: expected an image"),
    ):
        with pytest.raises(InputError, match=message):
            command(*arguments)
    assert not (tmp_path / "a.png").exists()
