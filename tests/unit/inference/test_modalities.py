"""Modalities as binary images and back: resampling against a closed form, boxes and flow by hand, moved objects."""

import json
import struct
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from transformers import YolosConfig, YolosForObjectDetection

from zerobev.common.errors import InputError
from zerobev.config import LABELS, CameraConfig
from zerobev.evaluation.motion import MovingPair, arrow_errors, motion_table, moving_pair, true_flow
from zerobev.geometry.cameras import Pose
from zerobev.inference import BevMap, Boxes, Flow, HubDetector, Projector
from zerobev.inference.bev_map import CLASS_COLORS, NOTHING, OUTSIDE, colors_of
from zerobev.inference.boxes import rendered_boxes
from zerobev.inference.flow import flow_field, read_flo
from zerobev.rendering.gbuffer import RayCaster
from zerobev.rendering.photograph import Photographer
from zerobev.scenes.moving import movable, moved

from support.scenes import box, build, furnished, room

CAMERA = CameraConfig(fpv_px=64, bev_px=40)


# --- boxes --------------------------------------------------------------------------------------------------------


def test_boxes_are_filled_between_their_corners(tmp_path):
    (tmp_path / "boxes.csv").write_text("label,score,xmin,ymin,xmax,ymax\nchair,0.75,1,0,3,2\nplant,0.5,-2,2.6,1,9\n")
    boxes = Boxes.read_csv(tmp_path / "boxes.csv")
    (images,) = boxes.layers((4, 5))
    chair, plant = images.images
    assert images.labels == ("chair", "plant") and images.scores.tolist() == [0.75, 0.5]
    assert np.argwhere(chair).tolist() == [[0, 1], [0, 2], [1, 1], [1, 2]]
    assert np.argwhere(plant).tolist() == [[3, 0]]
    with pytest.raises(InputError, match=r"expected box 0 within 1 x 3 pixels, found 1, 0, 3, 2"):
        boxes.layers((3, 1))


@pytest.mark.parametrize(
    ("values", "form", "size"),
    [
        ([[10, 20, 30, 60]], "xyxy", None),
        ([[10, 20, 20, 40]], "xywh", None),
        ([[20, 40, 20, 40]], "cxcywh", None),
        ([[0.1, 0.25, 0.3, 0.75]], "xyxy", (80, 100)),
        ([[0.1, 0.25, 0.2, 0.5]], "xywh", (80, 100)),
        (torch.tensor([[0.2, 0.5, 0.2, 0.5]], requires_grad=True), "cxcywh", (80, 100)),
    ],
)
def test_boxes_in_other_formats_are_the_same_boxes(values, form, size):
    boxes = Boxes.of(values, ["chair"], form=form, size=size)
    np.testing.assert_allclose(boxes.corners, [[10, 20, 30, 60]], rtol=1e-6)
    assert boxes.scores.tolist() == [1]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Boxes([[0.1, 0.2, 0.5, 0.9]], ["a"], [1]), r"expected corners in pixels, .*size=\(height, width\)"),
        (lambda: Boxes([[50, 60, 20, 10]], ["a"], [1]), r"found 50, 60, 20, 10; for x, y, width, height .*xywh"),
        (lambda: Boxes.of([[1, 2, 3, 4]], ["a"], form="yxyx"), "form: expected xyxy, xywh or cxcywh, found 'yxyx'"),
        (lambda: Boxes.of([[1, 2, 3, 4]], ["a"], size=(9, 9)), "expected fractions of the image, found up to 4"),
        (lambda: Boxes.of([1, 2, 3, 4], ["a"]), r"expected numbers \(N, 4\), found int64 \(4,\)"),
    ],
)
def test_boxes_in_another_format_than_stated_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"xmin": [1]}, r"expected columns xmin, ymin, xmax, ymax, label, found xmin"),
        ({"xmin": [3], "ymin": [0], "xmax": [3], "ymax": [2], "label": ["a"]}, r"xmin < xmax and ymin < ymax in box 0"),
        ({"xmin": [np.nan], "ymin": [0], "xmax": [3], "ymax": [2], "label": ["a"]}, r"in box 0, found nan"),
        ({"xmin": ["x"], "ymin": [0], "xmax": [3], "ymax": [2], "label": ["a"]}, r"expected numbers"),
        ({"xmin": [1], "ymin": [0], "xmax": [3], "ymax": [2], "label": ["a"], "score": [2]}, r"scores in \[0, 1\]"),
    ],
)
def test_tables_without_valid_boxes_are_refused(table, message):
    with pytest.raises(InputError, match=message):
        Boxes.from_table(pd.DataFrame(table))


def test_rendered_boxes_enclose_their_instances_without_noise():
    instance = np.zeros((40, 50), int)
    instance[5:15, 10:30], instance[20:40, 0:9], instance[0, 0] = 3, 4, 5
    names = {3: "bed", 4: "chair", 5: "tv"}
    exact = rendered_boxes(instance, names, np.random.default_rng(0), jitter=0, misses=0)
    assert exact.labels == ("bed", "chair") and exact.corners.tolist() == [[10, 5, 30, 15], [0, 20, 9, 40]]
    assert exact.scores.tolist() == [1, 1] and "rendered" in exact.source
    rng = np.random.default_rng(1)
    noisy = [rendered_boxes(instance, {3: "bed"}, rng, jitter=0.1, misses=0.25) for _ in range(400)]
    corners = np.concatenate([boxes.corners for boxes in noisy])
    assert len(corners) == pytest.approx(300, abs=30)
    np.testing.assert_allclose(corners.std(axis=0), [2, 1, 2, 1], rtol=0.15)
    scores = np.concatenate([boxes.scores for boxes in noisy])
    assert 0.5 < scores.mean() < 0.95 and scores.max() <= 1


def test_a_detector_from_a_folder_gives_boxes_in_pixels_of_the_photograph(tmp_path):
    torch.manual_seed(0)
    network = YolosForObjectDetection(
        YolosConfig(
            hidden_size=16,
            num_hidden_layers=1,
            num_attention_heads=2,
            intermediate_size=16,
            image_size=[32, 48],
            patch_size=16,
            num_detection_tokens=5,
            id2label={0: "chair", 1: "plant", 2: "tv"},
        )
    ).eval()
    network.save_pretrained(tmp_path)
    settings = {"image_processor_type": "YolosImageProcessor", "size": {"height": 32, "width": 48}, "do_pad": False}
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(settings))
    rgb = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    seen = []
    detector = HubDetector.from_pretrained(tmp_path)
    detector._network.register_forward_hook(lambda module, args, outputs: seen.append(outputs))
    boxes = detector.detect(rgb, min_score=0.0)
    probability = seen[0].logits[0].softmax(-1)[:, :-1]
    x, y, width, height = seen[0].pred_boxes[0].numpy().T
    expected = np.stack([x - width / 2, y - height / 2, x + width / 2, y + height / 2], axis=1) * [96, 64, 96, 64]
    np.testing.assert_allclose(boxes.corners, expected, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(boxes.scores, probability.max(-1).values, rtol=1e-5)
    assert boxes.labels == tuple(("chair", "plant", "tv")[k] for k in probability.argmax(-1)) and len(boxes.labels) == 5
    assert detector.detect(rgb, min_score=0.999).labels == ()
    with pytest.raises(InputError, match="expected an object detector"):
        HubDetector.from_pretrained(tmp_path / "nothing")


# --- flow ---------------------------------------------------------------------------------------------------------


def test_flow_points_from_the_first_frame_to_the_second():
    y, x = np.mgrid[:64, :64]
    frames = [np.sin(0.3 * (x - dx))[..., None] * np.cos(0.23 * (y - dy))[..., None] for dx, dy in ((0, 0), (2, 1))]
    first, second = (np.repeat(0.5 + 0.5 * frame, 3, axis=2) for frame in frames)
    field = flow_field(first, second)
    assert np.median(field[10:-10, 10:-10], axis=(0, 1)) == pytest.approx([2, 1], abs=0.3)


def test_vectors_are_at_moving_points_of_a_grid():
    field = np.zeros((40, 60, 2), np.float32)
    field[10:20, 30:50] = (4, -3)
    flow = Flow.of(field, spacing_px=5)
    assert len(flow.start_px) == 8
    np.testing.assert_allclose(flow.end_px - flow.start_px, np.tile([4, -3], (8, 1)))
    columns, rows = np.floor(flow.start_px).astype(int).T
    assert (field[rows, columns] == (4, -3)).all()
    starts, ends = (np.stack(list(images.images)) for images in flow.layers((40, 60)))
    for discs, points in ((starts, flow.start_px), (ends, flow.end_px)):
        centres = [np.argwhere(disc).mean(axis=0)[::-1] + 0.5 for disc in discs]
        np.testing.assert_allclose(centres, points, atol=0.3)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        (np.zeros((4, 4)), r"expected floating point \(H, W, 2\), found float64 \(4, 4\)"),
        (np.zeros((4, 4, 2), int), r"found int64"),
        (np.zeros((2, 4, 5), np.float32), r"found float32 \(2, 4, 5\): move the components last"),
        (np.full((4, 4, 2), np.nan), r"expected a vector of 1 px at least, found none; 0% of the vectors are known"),
        (np.zeros((4, 4, 2)), r"expected a vector of 1 px at least, found none; 100%"),
    ],
)
def test_fields_without_flow_are_refused(field, message):
    with pytest.raises(InputError, match=f"flow: .*{message}"):
        Flow.of(field)


@pytest.mark.parametrize("unknown", [1e10, -1.6e9, np.nan, np.inf])
def test_no_vector_starts_where_flow_is_unknown(unknown):
    field = np.zeros((48, 48, 2), np.float32)
    field[10:30, 10:30] = (4, -3)
    known = Flow.of(field)
    field[:20, :, 0] = unknown
    flow = Flow.of(field)
    assert 0 < len(flow.start_px) < len(known.start_px)
    np.testing.assert_array_equal(flow.start_px, known.start_px[known.start_px[:, 1] > 20])


def test_a_flo_file_of_middlebury_is_read_exactly(tmp_path):
    field = np.random.default_rng(0).normal(0, 9, (5, 7, 2)).astype("<f4")
    field[0] = 1.7e9
    path = tmp_path / "a.flo"
    whole = struct.pack("<fii", 202021.25, 7, 5) + field.tobytes()
    path.write_bytes(whole)
    np.testing.assert_array_equal(read_flo(path), field)
    np.testing.assert_array_equal(Flow.read(path, spacing_px=1).start_px, Flow.of(field, spacing_px=1).start_px)
    for content, message in (
        (whole[:-1], "expected 12 bytes and 8 per pixel, found 7 x 5 pixels in 291 bytes"),
        (whole + b"x", "in 293 bytes"),
        (struct.pack("<fii", 202021.25, -7, -5) + field.tobytes(), "found -7 x -5 pixels"),
        (struct.pack(">fii", 202021.25, 7, 5) + field.tobytes(), "starts with b'PIEH', found b'HEIP'"),
        (b"\x89PNG\r\n", r"decode it and use Flow.of"),
        (b"PIEH\1", "found 1 x 0 pixels in 5 bytes"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=f"a.flo: .*{message}"):
            Flow.read(path)
    with pytest.raises(InputError, match=r"none\.flo: expected a \.flo file, found: No such file"):
        Flow.read(tmp_path / "none.flo")


# --- maps ---------------------------------------------------------------------------------------------------------


def test_a_map_is_metric(tmp_path):
    values = np.zeros((3, 40, 40), np.float32)
    values[0, 8:12, 20:24] = 0.9  # 0 to 0.5 m right, 3.5 to 4 m forward
    values[1, 39, 0] = 0.2
    fov = np.ones((40, 40), bool)
    fov[8, 20] = False
    bev = BevMap(values, ("a", "b", "c"), values, fov, CAMERA, np.array([0.5, 0.6, 0.7]))
    assert bev.extent == (-2.5, 2.5, 0.0, 5.0) and bev.cell_m == 0.125
    table = bev.footprints()
    assert table["area_m2"].tolist() == pytest.approx([15 * 0.125**2, 0, 0])
    assert bev.centres_m[0] == pytest.approx([0.25 + 0.1875 / 15, 3.75 - 0.1875 / 15])
    assert bev.centres_m[1] == pytest.approx([-2.4375, 0.0625])  # although its map is empty
    assert np.isnan(bev.centres_m[2]).all()
    bev.save(str(tmp_path / "map"))  # the suffix is added
    assert [path.name for path in tmp_path.iterdir()] == ["map.npz"]
    for name in ("map.png", "map.npz/map", ""):
        with pytest.raises(InputError, match=r"expected a (name that ends in \.npz|file that can be written)"):
            bev.save(tmp_path / name if name else "")
    assert [path.name for path in tmp_path.iterdir()] == ["map.npz"]
    with np.load(tmp_path / "map.npz") as file:
        np.testing.assert_array_equal(file["maps"], bev.maps)
        assert file["maps"].sum() == 15 and file["labels"].tolist() == ["a", "b", "c"]
        assert file["extent"].tolist() == [-2.5, 2.5, 0, 5] and file["scores"].tolist() == [0.5, 0.6, 0.7]
    axes = bev.show()
    assert axes.get_images()[0].get_extent() == [-2.5, 2.5, 0, 5] and "[m]" in axes.get_xlabel()
    legend = [text.get_text() for text in axes.get_legend().get_texts()]
    assert legend == ["a 0.50", "b 0.60", "nothing", "outside the view"]
    assert axes.lines[0].get_xydata()[0] == pytest.approx([-2.4375, 0.0625])


def test_the_first_map_of_a_class_has_the_colour_of_all_figures():
    names = ("shelf", "sofa", "sofa", "wall", "lamp")
    colors = colors_of(names)
    assert [colors[k] for k in (1, 3)] == [to_rgb(CLASS_COLORS[LABELS.index(names[k])]) for k in (1, 3)]
    assert len(set(colors)) == 5 and colors[2] not in map(to_rgb, CLASS_COLORS)
    values = np.zeros((5, 4, 4), np.float32)
    values[1, 0, 0] = values[4, 0, 1] = 1
    fov = np.arange(16).reshape(4, 4) < 12
    bev = BevMap(values, names, values, fov, CameraConfig(fpv_px=4, bev_px=4))
    image = bev.image()
    expected = [colors[1], colors[4], to_rgb(NOTHING), to_rgb(OUTSIDE)]
    np.testing.assert_allclose([image[0, 0], image[0, 1], image[0, 2], image[3, 0]], expected)
    legend = bev.show(Figure().subplots()).get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["sofa", "lamp", "nothing", "outside the view"]
    np.testing.assert_allclose([patch.get_facecolor()[:3] for patch in legend.get_patches()], expected)
    full = BevMap(np.ones((13, 4, 4), np.float32), tuple("abcdefghijklm"), values, fov | True, bev.camera)
    assert full.show(Figure().subplots()).get_legend().get_texts() == []  # too many for a legend, and no other cells


# --- moved objects ------------------------------------------------------------------------------------------------


def test_a_moved_object_is_elsewhere_in_all_sensors_and_the_rest_is_unchanged():
    scene = build(furnished())
    chair = next(i.id for i in scene.instances if i.name == "chair")
    assert chair in movable(scene)
    after = moved(scene, chair, np.array([-0.25, -0.5, 0.0]))
    pose = Pose(2.5, 0.1, 0.0, np.pi / 2)  # forward is +y, so map and world axes agree
    before_map, after_map = (RayCaster(one).bev(pose, CAMERA).instance == chair for one in (scene, after))
    assert before_map.sum() == 16
    np.testing.assert_array_equal(after_map, np.roll(before_map, (4, -2), (0, 1)))  # 50 cm nearer, 25 cm to the left
    cast = RayCaster(after).fpv(pose, CAMERA)
    here = cast.instance == chair
    agree = [np.abs(Photographer(one, CAMERA).depth(pose)[::2, ::2] - cast.distance) < 0.1 for one in (after, scene)]
    assert agree[0].mean() > 0.97 and agree[0][here].mean() > 0.8 and agree[1][here].mean() < 0.2
    with pytest.raises(InputError, match="one mesh"):
        moved(replace(scene, vertices=scene.vertices + np.float32(0.5)), chair, np.zeros(3))


def test_true_flow_by_hand():
    camera = CameraConfig(fpv_px=100, bev_px=40, hfov_deg=90)
    points = np.array([[[1.0, 2.0, 0.88], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]]])  # the last one is a pixel without a point
    flow = true_flow(points, np.array([0.0, -1.0, 0.0]), camera)
    assert flow[0].tolist() == [[pytest.approx(25), 0], [0, pytest.approx(22)], [0, 0]]


def pair_of_a_moving_box(seed: int) -> tuple[MovingPair, tuple[int, int, int]]:
    things = [*room((5, 4, 2.5)), box("chair", (2.2, 1.9, 0), (2.8, 2.5, 0.8))]
    scene = build(things)
    pair = moving_pair(scene, CAMERA, np.random.default_rng(seed))
    assert pair is not None
    return pair, scene.instances[-1].color


@pytest.mark.parametrize("seed", [0, 1])
def test_true_flow_ends_on_the_object_in_the_second_photograph(seed):
    pair, color = pair_of_a_moving_box(seed)
    rows, columns = np.nonzero(pair.on_object)
    assert np.mean(np.abs(pair.first[rows, columns].astype(int) - color).max(axis=-1) < 12) > 0.95
    ends = np.round(np.stack([columns, rows], axis=1) + pair.flow_px[rows, columns]).astype(int)
    inside = ((ends >= 0) & (ends < 256)).all(axis=1)
    colors = pair.second[ends[inside, 1], ends[inside, 0]].astype(int)
    assert inside.mean() > 0.3 and np.mean(np.abs(colors - color).max(axis=-1) < 12) > 0.85
    assert not pair.flow_px[~pair.on_object].any() and 0.2 <= np.linalg.norm(pair.motion_m) <= 0.6


def test_a_home_without_movable_objects_has_no_pair():
    assert moving_pair(build(room((5, 4, 2.5))), CAMERA, np.random.default_rng(0)) is None


def test_errors_of_arrows_grow_with_errors_of_depth():
    pair, _ = pair_of_a_moving_box(0)
    depth = torch.from_numpy(np.where(pair.on_object, pair.point_m[..., 1], 0).astype(np.float32))
    coarse = depth[2::4, 2::4][None, None]  # of the first frame, for both frames: the end may miss the object
    errors = arrow_errors(Projector("a.1", CAMERA, None, lambda rgb: coarse), pair, pair.flow_px)
    assert errors["start"].median() < 0.15
    doubled = arrow_errors(Projector("a.1", CAMERA, None, lambda rgb: coarse * 1.5), pair, pair.flow_px)
    assert doubled["start"].median() > 3 * errors["start"].median()
    assert arrow_errors(Projector("a.1", CAMERA, None, lambda rgb: coarse), pair, 0 * pair.flow_px) is None


def test_the_table_of_motion_has_means_over_pairs():
    lines = [(k, "true", "d", 10, 0.1, 0.1 * k, 0.2 * k, 0.3) for k in range(5)]
    names = ["pair", "flow", "row", "vectors", "missing", "start", "end", "motion"]
    line = motion_table(pd.DataFrame(lines, columns=names)).loc[("true", "d")]
    assert line["pairs"] == 5 and line["vectors"] == 50 and line["missing"] == 0.1
    assert line["start [m]"].startswith("0.20 [0.") and line["motion [m]"] == "0.30"
