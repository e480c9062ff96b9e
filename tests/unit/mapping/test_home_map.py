"""A home's map from views: closed forms, rotations, fusion, and what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.figure import Figure

import zerobev
from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.inference import BevArrows, BevMap
from zerobev.mapping import HomeMap, Pose2D
from zerobev.mapping.home_map import HIGHEST, LIMIT, LOWEST, PRIOR

#: A map of 4 x 4 cells of 1 m: row 0 is 3 to 4 m ahead, column 0 is 1 to 2 m to the left.
CAMERA = CameraConfig(fpv_px=8, bev_px=4, bev_extent_m=4.0)
SOME = 0.7  # a probability within the limit of a view


def view(values, labels=("chair",), fov=None, camera: CameraConfig = CAMERA) -> BevMap:
    """Values (K, M, M), or the same value everywhere."""
    side = camera.bev_px
    values = np.broadcast_to(np.asarray(values, np.float32), (len(labels), side, side)).copy()
    return BevMap(values, tuple(labels), values, np.ones((side, side), bool) if fov is None else fov, camera)


def one_cell(row: int, column: int) -> BevMap:
    """A view that sees one cell alone."""
    fov = np.zeros((4, 4), bool)
    fov[row, column] = True
    return view(SOME, fov=fov)


def cells_of(home: HomeMap) -> set[tuple[int, int]]:
    """The world's cells of 1 m that were in view, by their lower left corners."""
    x0, _, _, y1 = home.grid.extent
    return {(int(x0) + column, int(y1) - 1 - row) for row, column in np.argwhere(home.viewed).tolist()}


# --- geometry -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("yaw", "expected"),
    [
        # the cell 2 to 3 m ahead, 1 to 2 m to the right, of a camera at (10, 20)
        (0, (12, 18)),  # along +x: right is -y
        (math.pi / 2, (11, 22)),  # along +y: right is +x
        (math.pi, (7, 21)),
        (-math.pi / 2, (8, 17)),
        (2 * math.pi, (12, 18)),
        (-2.5 * math.pi, (8, 17)),
    ],
)
def test_a_cell_of_a_view_lies_where_the_pose_puts_it(yaw: float, expected: tuple[int, int]):
    home = HomeMap((0, 10, 30, 40), 1.0)
    home.add(one_cell(row=1, column=3), Pose2D(10, 20, yaw))
    assert cells_of(home) == {expected}
    assert home.probabilities("chair")[home.viewed] == pytest.approx(SOME)
    assert home.probabilities("chair")[~home.viewed] == pytest.approx(PRIOR)


def test_row_0_is_at_the_largest_y_and_column_0_at_the_smallest_x():
    home = HomeMap((-2, 1, 3, 4), 0.5)
    home.add(one_cell(row=3, column=2), Pose2D(2, 1, math.pi / 2))  # x from 2 to 3, y from 1 to 2
    assert home.grid.shape == (6, 10)
    assert np.array_equal(np.argwhere(home.viewed), [(row, column) for row in (4, 5) for column in (8, 9)])


@given(x=st.floats(-3, 3), y=st.floats(-3, 3), yaw=st.floats(-6, 6), cell_m=st.sampled_from([0.1, 0.25, 0.4]))
def test_each_cell_takes_the_value_of_the_cell_around_its_centre(x: float, y: float, yaw: float, cell_m: float):
    """Against the definition, with complex numbers: forward is the direction of yaw, right a quarter turn clockwise."""
    values = np.linspace(0.3, 0.7, 16, dtype=np.float32).reshape(1, 4, 4)
    home = HomeMap((-4, -4, 5, 4.7), cell_m)
    home.add(view(values), Pose2D(x, y, yaw))
    left, _, _, top = home.grid.extent
    found, viewed = home.probabilities("chair"), home.viewed
    for row, column in np.ndindex(*(side // 4 for side in home.grid.shape)):
        row, column = 4 * row, 4 * column
        centre = complex(left + (column + 0.5) * cell_m, top - (row + 0.5) * cell_m)
        local = (centre - complex(x, y)) * np.exp(-1j * yaw)
        across, ahead = 2 - local.imag, local.real
        if min(abs(value - round(value)) for value in (across, ahead)) < 1e-4:
            continue  # on a border between two cells
        on_map = 0 <= across < 4 and 0 <= ahead < 4
        expected = values[0, 3 - int(ahead), int(across)] if on_map else PRIOR
        assert abs(found[row, column] - expected) < 1e-6 and viewed[row, column] == on_map


def test_parts_outside_the_extent_are_left_out():
    home = HomeMap((0, 0, 2, 2), 1.0)
    home.add(view(SOME), Pose2D(1, 1, 0))
    assert cells_of(home) == {(1, 0), (1, 1)}
    home.add(view(SOME), Pose2D(2, 2, math.pi / 4))  # in the corner, looking out
    assert cells_of(home) == {(1, 0), (1, 1)}


def test_a_grid_is_as_large_as_needed():
    assert HomeMap((0, 0, 1, 0.7), 0.1).grid.shape == (7, 10)
    grid = HomeMap((1, 2, 2.05, 2.71), 0.1).grid
    assert grid.shape == (8, 11) and grid.extent == pytest.approx((1, 2, 2.1, 2.8))


# --- fusion -------------------------------------------------------------------------------------------------------


def fused(*values: float) -> float:
    """The probability of a cell after views with these values."""
    home = HomeMap((0, 0, 8, 8), 1.0)
    for value in values:
        home.add(view(value), Pose2D(4, 4, 0))
    return float(home.probabilities("chair")[home.viewed].mean())


def test_log_odds_by_hand():
    assert fused(0.7) == pytest.approx(0.7)
    odds = [p / (1 - p) for p in (0.8, 0.6, PRIOR)]
    assert fused(0.8, 0.6) == pytest.approx(1 / (1 + odds[2] / (odds[0] * odds[1])))
    assert fused(0.8, PRIOR, PRIOR) == pytest.approx(0.8)  # a view with the prior says nothing
    assert fused(0) == pytest.approx(LOWEST) and fused(1) == pytest.approx(HIGHEST)
    assert fused(0.8, 0.1) < 0.8 and fused(1, 0) > 0.5 > fused(1, 0, 0)  # views that contradict each other
    assert fused(*[1] * 50) == pytest.approx(1 / (1 + math.exp(-LIMIT)))
    assert fused(*[1] * 50, *[0] * 4) < 0.5  # a wrong cell recovers


VALUES = arrays(np.float32, (2, 4, 4), elements=st.floats(0, 1, width=32))
FOVS = arrays(bool, (4, 4))
POSES = st.builds(Pose2D, st.floats(0, 6), st.floats(0, 6), st.floats(-6, 6))


@given(st.lists(st.tuples(VALUES, FOVS, POSES), min_size=2, max_size=2))
def test_the_order_of_views_does_not_matter_below_the_limit(views):
    """Two views do not reach it."""
    homes = [HomeMap((0, 0, 6, 6), 0.5) for _ in range(2)]
    for home in homes:
        for values, fov, pose in views:
            home.add(view(values, ("chair", "sofa"), fov), pose)
        views = views[::-1]
    for name in ("chair", "sofa"):
        np.testing.assert_allclose(*(home.probabilities(name) for home in homes), atol=1e-6)
        np.testing.assert_allclose(*(home.means(name) for home in homes), atol=1e-6)
    assert np.array_equal(homes[0].viewed, homes[1].viewed)


@given(VALUES, FOVS, POSES)
def test_nothing_changes_outside_the_field_of_view(values, fov, pose):
    home = HomeMap((0, 0, 6, 6), 0.5)
    home.add(view(values, ("chair", "sofa"), fov), pose)
    for name in home.layers:
        assert home.probabilities(name)[~home.viewed] == pytest.approx(PRIOR)
        assert np.isnan(home.means(name)[~home.viewed]).all() and not home.maps[name][~home.viewed].any()


def test_a_layer_starts_with_its_first_view():
    home = HomeMap((0, 0, 8, 8), 1.0)
    home.add(view(SOME, ["floor"]), Pose2D(4, 4, 0))
    home.add(view([[[0.8]], [[0.6]]], ["edges", "floor"]), Pose2D(4, 4, math.pi))
    assert home.layers == ("floor", "edges")
    ahead, behind = np.zeros((2, 8, 8), bool)
    ahead[2:6, 4:], behind[2:6, :4] = True, True
    assert np.array_equal(home.maps["floor"], ahead | behind) and np.array_equal(home.maps["edges"], behind)
    assert home.probabilities("edges")[ahead] == pytest.approx(PRIOR) and np.isnan(home.means("edges")[ahead]).all()


def test_values_that_are_no_probabilities_have_a_mean():
    home = HomeMap((0, 0, 8, 8), 1.0)
    for value in (0.9, 0.9, 0.3):
        home.add(view(value, ["heat"]), Pose2D(4, 4, 0))
    assert home.means("heat")[home.viewed] == pytest.approx(0.7)


def test_two_maps_of_one_name_are_one_map():
    """As of two boxes of chairs: a cell of the second is not the absence of the first."""
    values = np.zeros((2, 4, 4), np.float32)
    values[0, 0, 0] = values[1, 3, 3] = 1
    home = HomeMap((0, 0, 8, 8), 1.0)
    home.add(view(values, ("chair", "chair")), Pose2D(4, 4, 0))
    assert home.layers == ("chair",) and home.maps["chair"].sum() == 2
    assert home.means("chair")[home.viewed].sum() == 2


# --- crop, files, pictures ------------------------------------------------------------------------------------------


def walked() -> HomeMap:
    home = HomeMap((-1, -2, 9, 8), 0.5)
    rng = np.random.default_rng(0)
    for pose in (Pose2D(4, 4, 0.3), Pose2D(3, 4.2, 1.0)):
        home.add(view(rng.random((2, 4, 4)), ("floor", "chair")), pose)
    return home


def test_a_cropped_map_has_the_same_cells_at_the_same_places():
    home = walked()
    part = home.crop()
    assert part.viewed.any(axis=0)[[0, -1]].all() and part.viewed.any(axis=1)[[0, -1]].all()
    assert part.viewed.sum() == home.viewed.sum()
    offset = (np.array(part.grid.extent) - home.grid.extent) / 0.5
    left, bottom, right, top = np.rint(offset).astype(int)
    np.testing.assert_allclose(offset, np.rint(offset), atol=1e-9)
    window = slice(-top, home.grid.shape[0] - bottom), slice(left, home.grid.shape[1] + right)
    for name in ("floor", "chair"):
        assert np.array_equal(part.probabilities(name), home.probabilities(name)[window])
    pose = Pose2D(4, 4.5, -2)  # further views are added to it as to the whole map
    for one in (home, part):
        one.add(view(SOME, ["floor"]), pose)
    assert np.array_equal(part.probabilities("floor"), home.probabilities("floor")[window])


def test_a_saved_map_continues_as_if_it_were_never_saved(tmp_path):
    home = walked()
    home.save(tmp_path / "home")
    again = HomeMap.load(tmp_path / "home.npz")
    for one in (home, again):
        one.add(view(SOME, ["edges"]), Pose2D(2, 2, 2))
    assert again.layers == ("floor", "chair", "edges") and again.grid == home.grid
    for name in home.layers:
        assert np.array_equal(again.probabilities(name), home.probabilities(name))
        np.testing.assert_array_equal(again.means(name), home.means(name))
    with pytest.raises(InputError, match="as in earlier views"):
        HomeMap.load(tmp_path / "home.npz").add(view(0.5, camera=replace(CAMERA, bev_px=8)), Pose2D(2, 2, 2))
    HomeMap((0, 0, 1, 1), 0.5).save(tmp_path / "empty.npz")
    assert HomeMap.load(tmp_path / "empty.npz").layers == ()


def test_a_file_that_is_no_map_is_refused_in_one_line(tmp_path):
    walked().save(tmp_path / "home.npz")
    whole = (tmp_path / "home.npz").read_bytes()
    np.savez(tmp_path / "other.npz", maps=np.zeros(3))
    saved = dict(np.load(tmp_path / "home.npz"))
    np.savez(tmp_path / "bent.npz", **(saved | {"views": saved["views"][:, 1:]}))
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.npz").write_text("map")
    for name in ("other.npz", "bent.npz", "cut.npz", "text.npz", "none.npz"):
        with pytest.raises(InputError, match=f"{name}: expected a saved HomeMap, found: .") as caught:
            HomeMap.load(tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"path: expected a name that ends in \.npz, found .*home\.txt"):
        walked().save(tmp_path / "home.txt")


def test_a_picture_shows_each_layer_and_what_was_seen():
    home = HomeMap((0, 0, 8, 8), 1.0)
    values = np.zeros((2, 4, 4), np.float32)
    values[0, :, :3], values[1, 0, 0] = 1, 1  # the small layer lies above the large one
    home.add(view(values, ("floor", "chair")), Pose2D(4, 4, 0))
    colours = np.unique(home.image().reshape(-1, 3), axis=0, return_counts=True)
    assert sorted(colours[1].tolist()) == [1, 4, 11, 48]
    axes = home.show(Figure().subplots())
    legend = [text.get_text() for text in axes.get_legend().get_texts()]
    assert legend == ["floor", "chair", "nothing", "outside the view"]
    assert axes.get_images()[0].get_extent() == [0, 8, 0, 8]


# --- what is refused ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("extent", "cell_m", "message"),
    [
        ((0, 0, 1000, 800), 0.1, "extent: expected metres, at most 150 across, found 1000 x 800: centimetres?"),
        ((0, 0, 10, 8), 12.5, "cell_m: expected metres, more than 0 and at most 1, found 12.5: centimetres?"),
        ((0, 0, 10, 8), 0, "cell_m: expected metres, more than 0 and at most 1, found 0"),
        ((0, 0, 10, 8), math.nan, "cell_m: expected metres, more than 0 and at most 1, found nan"),
        ((0, 0, 100, 80), 0.001, "cell_m: expected at most 16000000 cells, found 8000000000: take larger ones"),
        ((0, 8, 10, 0), 0.1, "extent: expected x0 < x1 and y0 < y1, found (0.0, 8.0, 10.0, 0.0)"),
        ((0, 0, 10), 0.1, "extent: expected x0, y0, x1, y1 in metres, found (0, 0, 10)"),
        ((0, 0, math.inf, 8), 0.1, "extent: expected x0, y0, x1, y1 in metres, found (0, 0, inf, 8)"),
    ],
)
def test_a_grid_that_cannot_be_in_metres_is_refused(extent, cell_m, message: str):
    with pytest.raises(InputError) as caught:
        HomeMap(extent, cell_m)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ((1, 1, 90), "pose.yaw: expected radians, at most two turns, found 90: degrees?"),
        ((math.nan, 1, 0), "pose.x: expected a finite number, found nan"),
        ((1, -math.inf, 0), "pose.y: expected a finite number, found -inf"),
        ((1, "1", 0), "pose.y: expected a number, found '1'"),
        ((1, 1, True), "pose.yaw: expected a number, found True"),
        ((350, 420, 0), "pose: expected x from 0 to 10 and y from 0 to 8 metres, the map's extent, found (350, 420)"),
    ],
)
def test_a_pose_without_a_place_is_refused(pose, message: str):
    home = HomeMap((0, 0, 10, 8), 0.5)
    with pytest.raises(InputError) as caught:
        home.add(view(SOME), Pose2D(*pose))
    assert str(caught.value) == message and home.layers == ()


@pytest.mark.parametrize(
    ("bev", "message"),
    [
        (view(0.5, camera=replace(CAMERA, bev_px=8)), "expected 4 cells of 1 m per side, as in .*, found 8 of 0.5 m"),
        (view(0.5, camera=replace(CAMERA, bev_px=5, bev_extent_m=5.0)), "found 5 of 1 m"),
        (view(1.5), r"bev.values: expected values in \[0, 1\]"),
        (view(math.nan), r"bev.values: expected values in \[0, 1\]"),
        (BevArrows(view(0.5), view(0.5)), "bev: expected a BevMap, found BevArrows"),
    ],
)
def test_a_map_that_does_not_fit_is_refused_and_changes_nothing(bev, message: str):
    home = HomeMap((0, 0, 10, 8), 0.5)
    home.add(view(SOME), Pose2D(4, 4, 0))
    before = home.probabilities("chair")
    with pytest.raises(InputError, match=message):
        home.add(bev, Pose2D(4, 4, 0))
    assert np.array_equal(home.probabilities("chair"), before)
    home.add(view(SOME, camera=replace(CAMERA, fpv_px=64, hfov_deg=60.0)), Pose2D(4, 4, 0))  # another camera
    with pytest.raises(InputError, match="pose: expected a Pose2D, found tuple"):
        home.add(view(SOME), (4, 4, 0))


def test_unknown_layers_and_empty_maps_are_named():
    home = HomeMap((0, 0, 10, 8), 0.5)
    with pytest.raises(InputError, match="layer: expected one of none, found 'sofa'"):
        home.probabilities("sofa")
    with pytest.raises(InputError, match="map: expected cells in the field of view of a view, found none"):
        home.crop()
    home.add(view(SOME), Pose2D(4, 4, 0))
    with pytest.raises(InputError, match="layer: expected one of chair, found 'sofa'"):
        home.means("sofa")


def test_the_package_names_both():
    assert zerobev.HomeMap is HomeMap and zerobev.Pose2D is Pose2D
