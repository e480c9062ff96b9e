"""G-buffers of hand-made rooms against closed forms, FPV against BEV, and ray caster against rasteriser."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from OpenGL.plugins import FormatHandler
from PIL import Image
from scipy import ndimage
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from zerobev.config import AgentConfig, CameraConfig
from zerobev.geometry.cameras import Pose, bev_cell_centres, fpv_rays
from zerobev.geometry.projection import map_points
from zerobev.rendering import surfaces
from zerobev.rendering.gbuffer import GBuffer, RayCaster
from zerobev.rendering.photograph import Photographer
from zerobev.rendering.poses import navigable_floor
from zerobev.scenes.indoor import generate_home
from zerobev.scenes.scene import Scene

from support.scenes import TEXEL_M, box, build, furnished, real_home, room

CAMERA = CameraConfig(fpv_px=48, bev_px=50)
POSES = (Pose(2.0, 0.5, 0, 1.0), Pose(4.4, 2.4, 0, -2.9), Pose(0.6, 3.5, 0, -0.7))
SIZE = np.array([5, 4, 2.5])
FLOOR, CEILING = 2, 1  # instance ids of a hand-made room


def world_points(seen: GBuffer, pose: Pose, camera: CameraConfig) -> np.ndarray:
    """(H, W, 3) hit points of FPV rays in the world frame."""
    return pose.centre(camera) + (fpv_rays(camera) * seen.distance[..., None]) @ pose.world_R_camera.T


def world_cells(pose: Pose, camera: CameraConfig, height: np.ndarray) -> np.ndarray:
    """(M, M, 3) centres of the map's cells at `height` above the floor, in the world frame."""
    right, forward = bev_cell_centres(camera)
    return np.stack([right, forward, height], axis=-1) @ pose.world_R_map.T + (pose.x, pose.y, pose.floor_z)


def test_floor_depth_of_an_empty_room_by_row():
    camera = CameraConfig(fpv_px=49, bev_px=20)
    seen = RayCaster(build(room((30, 30, 2.5)))).fpv(Pose(1, 15, 0, 0), camera)
    row = np.arange(49) + 0.5 - 24.5
    on_floor = seen.instance == FLOOR
    assert on_floor[row >= 2].all() and not on_floor[row < 1].any()
    depth = camera.focal_px * camera.height_m / np.where(row > 0, row, np.inf)
    assert seen.distance[on_floor] == pytest.approx(np.broadcast_to(depth[:, None], (49, 49))[on_floor], rel=1e-4)


@pytest.mark.parametrize("pose", POSES)
def test_depth_and_instance_of_an_empty_room(pose):
    """By the first of the six planes on each ray."""
    seen = RayCaster(build(room(SIZE))).fpv(pose, CAMERA)
    directions = fpv_rays(CAMERA) @ pose.world_R_camera.T
    centre = pose.centre(CAMERA)
    with np.errstate(divide="ignore"):
        exits = (np.where(directions > 0, SIZE, 0) - centre) / directions
    assert seen.distance == pytest.approx(exits.min(axis=-1), rel=1e-4)
    # ids by plane: -x and +x, -y and +y, floor and ceiling
    planes = np.array([[5, 6], [3, 4], [FLOOR, CEILING]])
    axis = exits.argmin(axis=-1)
    upper = np.take_along_axis(directions, axis[..., None], axis=-1)[..., 0] > 0
    clear = np.diff(np.sort(exits, axis=-1)[..., :2], axis=-1)[..., 0] > 1e-3
    assert (seen.instance == planes[axis, upper.astype(int)])[clear].all()


def expected_map(pose: Pose, camera: CameraConfig, things: dict[int, tuple]) -> tuple[np.ndarray, ...]:
    """Instance and height of every cell of a furnished room, and the cells away from all borders."""
    x, y, _ = np.moveaxis(world_cells(pose, camera, np.zeros((camera.bev_px,) * 2)), -1, 0)
    instance, height = np.zeros(x.shape, int), np.zeros(x.shape)
    clear = np.ones(x.shape, bool)
    for number, ((x0, y0, _), (x1, y1, z1)) in things.items():
        inside = np.minimum.reduce([x - x0, x1 - x, y - y0, y1 - y])
        clear &= np.abs(inside) > 1e-3
        instance[inside > 0], height[inside > 0] = number, z1
    return instance, height, clear


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("double_sided", [False, True])
def test_map_of_a_furnished_room(pose, double_sided):
    solids = {7: ((0.2, 0.3, 0), (1.8, 2.3, 0.5)), 8: ((2.6, 3.3, 0), (3.1, 3.8, 0.8)), 9: ((2, 1, 0), (3, 2, 0.02))}
    scene = build([*room(SIZE), *(box("chest", *corners) for corners in solids.values())], double_sided=double_sided)
    seen = RayCaster(scene).bev(pose, CAMERA)
    instance, height, clear = expected_map(pose, CAMERA, {FLOOR: ((0, 0, 0), (5, 4, 0)), **solids})
    assert clear.mean() > 0.9
    assert np.array_equal(seen.instance[clear], instance[clear])
    assert seen.distance[clear] == pytest.approx(height[clear], abs=1e-4)
    nothing = seen.texel[..., 0] < 0
    assert np.array_equal(nothing[clear], instance[clear] == 0)
    assert (seen.texel[nothing] == -1).all() and (seen.distance[nothing] == 0).all()
    assert not seen.instance[nothing].any()


def test_height_is_above_the_floor_of_the_pose():
    raised = [*room(SIZE, corner=(0, 0, 3)), box("bed", (2, 1.5, 3), (4, 2.5, 3.5))]
    seen = RayCaster(build(raised)).bev(Pose(1, 2, 3, 0), CAMERA)
    assert (seen.instance == 7).sum() > 100 and (seen.instance == FLOOR).sum() > 100
    assert seen.distance[seen.instance == 7] == pytest.approx(0.5, abs=1e-5)
    assert seen.distance[seen.instance == FLOOR] == pytest.approx(0, abs=1e-5)


def test_rays_pass_through_several_culled_faces():
    """From outside, through the backs of two rooms: a wall is visible only if it faces the camera."""
    scene = build([*room((2, 2, 2.5)), box("chest", (0.5, 0.5, 0), (1.5, 1.5, 1))])
    seen = RayCaster(scene).fpv(Pose(-1, 1, 0, 0), CAMERA)
    assert seen.instance[26, 24] == 7 and seen.distance[26, 24] == pytest.approx(1.5, abs=1e-4)
    assert seen.instance[20, 24] == 6 and seen.distance[20, 24] == pytest.approx(3, abs=1e-4)
    seen = RayCaster(replace(scene, double_sided=True)).fpv(Pose(-1, 1, 0, 0), CAMERA)
    assert seen.instance[26, 24] == 5 and seen.distance[26, 24] == pytest.approx(1, abs=1e-4)


def texel_distance(scene: Scene, texel: np.ndarray, instance: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Metres from each point to the centre of its texel, by the inverse UV map of the instance's faces."""
    best = np.full(len(points), np.inf)
    owner = scene.face_instance
    for face in range(len(scene.faces)):
        rows = np.flatnonzero((instance == owner[face]) & (texel[:, 0] == scene.face_chart[face]))
        size = scene.chart_instance[scene.face_chart[face]].shape[::-1]
        corners_px = scene.face_uv[face].astype(np.float64) * size
        to_weights = np.linalg.inv(np.vstack([corners_px.T, np.ones(3)]))
        weights = np.column_stack([texel[rows][:, [2, 1]] + 0.5, np.ones(len(rows))]) @ to_weights.T
        near = np.linalg.norm(weights @ scene.vertices[scene.faces[face]] - points[rows], axis=1)
        near[(weights < -0.2).any(axis=1)] = np.inf
        best[rows] = np.minimum(best[rows], near)
    return best


@pytest.mark.parametrize("pose", POSES)
def test_texel_is_at_the_visible_point(pose):
    scene = build(furnished())
    caster = RayCaster(scene)
    fpv, bev = caster.fpv(pose, CAMERA), caster.bev(pose, CAMERA)
    half_diagonal = TEXEL_M / np.sqrt(2) + 1e-4
    for seen, points in (
        (fpv, world_points(fpv, pose, CAMERA)),
        (bev, world_cells(pose, CAMERA, bev.distance)),
    ):
        hit = seen.texel[..., 0] >= 0
        distance = texel_distance(scene, seen.texel[hit], seen.instance[hit], points[hit])
        assert (distance <= half_diagonal).all()
        charts, rows, columns = seen.texel[hit].T
        owner = [scene.chart_instance[c][r, k] for c, r, k in zip(charts, rows, columns)]
        assert np.array_equal(owner, seen.instance[hit])


@pytest.mark.parametrize("pose", POSES)
def test_atlas_index_is_the_texel(pose):
    """Concatenated charts, and one more entry for no hit."""
    scene = build(furnished())
    laid_out = [
        np.stack([np.full(image.shape, chart), *np.indices(image.shape)], axis=-1).reshape(-1, 3)
        for chart, image in enumerate(scene.chart_instance)
    ]
    texels = np.concatenate([*laid_out, [(-1, -1, -1)]])
    caster = RayCaster(scene)
    for seen in (caster.fpv(pose, CAMERA), caster.bev(pose, CAMERA)):
        assert np.array_equal(texels[seen.atlas], seen.texel)
    assert (caster.bev(pose, CAMERA).atlas == len(texels) - 1).any()


HOMES = {
    "hand-made": lambda: build(furnished()),
    "generated": lambda: generate_home("Home", np.random.default_rng(0)),
    "real": real_home,
}


@pytest.fixture(scope="module", params=HOMES)
def home(request) -> tuple[Scene, list[Pose]]:
    scene = HOMES[request.param]()
    if request.param == "hand-made":
        return scene, list(POSES)
    rng = np.random.default_rng(0)
    floor = navigable_floor(scene, AgentConfig(), rng)
    return scene, [floor.draw(rng) for _ in range(10)]


def test_pair_is_aligned(home):
    """P1 and P2: a visible cell and its pixel show the same point of the surface."""
    scene, poses = home
    camera = CameraConfig(fpv_px=512, bev_px=50)
    caster = RayCaster(scene)
    compared = same_instance = same_value = mirrored_value = 0
    rng = np.random.default_rng(0)
    # a texture with structures of about 30 cm
    textures = [ndimage.gaussian_filter(rng.standard_normal(image.shape), 8) > 0 for image in scene.chart_instance]
    for pose in poses:
        fpv, bev = caster.fpv(pose, camera), caster.bev(pose, camera)
        points = world_cells(pose, camera, bev.distance) - pose.centre(camera)
        x, y, z = np.moveaxis(points @ pose.world_R_camera, -1, 0)
        column, row = (np.floor(axis / z * camera.focal_px + camera.fpv_px / 2).astype(int) for axis in (x, y))
        shown = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < camera.fpv_px) & (bev.texel[..., 0] >= 0)
        row, column = row[shown], column[shown]
        # pixels of the cell's point, at a distance of at most 5 cm
        centres = map_points(torch.from_numpy(fpv.distance), camera).numpy()[row, column]
        right, forward = bev_cell_centres(camera)
        cells = np.stack([right, forward, bev.distance], axis=-1)[shown]
        visible = np.linalg.norm(centres - cells, axis=-1) < 0.05
        in_fpv, in_bev = fpv.texel[row, column][visible], bev.texel[shown][visible]
        compared += visible.sum()
        same_instance += (fpv.instance[row, column][visible] == bev.instance[shown][visible]).sum()
        same_value += (look_up(textures, in_fpv) == look_up(textures, in_bev)).sum()
        mirrored_value += (look_up(textures, in_fpv) == look_up(textures, bev.texel[:, ::-1][shown][visible])).sum()
    assert compared > 300
    assert same_instance / compared > 0.97
    assert same_value / compared > 0.9
    assert mirrored_value / compared < 0.75


def look_up(textures: list[np.ndarray], texels: np.ndarray) -> np.ndarray:
    """Values of the textures at (N, 3) texels; False for no surface."""
    values = np.zeros(len(texels), bool)
    for chart, texture in enumerate(textures):
        on = texels[:, 0] == chart
        values[on] = texture[texels[on, 1], texels[on, 2]]
    return values


def interior(depth: np.ndarray) -> np.ndarray:
    """Pixels with one surface in their 3 x 3 neighbourhood: depth varies by less than 4 %."""
    lowest, highest = (f(depth, size=3, mode="nearest") for f in (ndimage.minimum_filter, ndimage.maximum_filter))
    return (lowest > 0) & (highest < 1.04 * lowest)


def test_ray_caster_and_rasteriser_agree_on_depth(home):
    """The rasteriser returns the depth of one of a pixel's samples, up to half a pixel from its centre."""
    scene, poses = home
    camera = replace(CAMERA, fpv_px=96)
    photographer, caster = Photographer(scene, camera), RayCaster(scene)
    twice = replace(camera, fpv_px=2 * camera.fpv_px)  # the rasteriser's super-sampled pixels
    agree, of = 0, 0
    for pose in poses:
        rasterised, cast = photographer.depth(pose), caster.fpv(pose, twice).distance
        inside = interior(cast)
        agree += (np.abs(rasterised - cast) <= np.maximum(0.01, 0.01 * cast))[inside].sum()
        of += inside.sum()
    assert of > 0.8 * len(poses) * twice.fpv_px**2
    assert agree >= 0.995 * of


@pytest.mark.parametrize("pose", POSES)
def test_photograph_agrees_with_the_ray_caster(pose):
    """A pixel of the photograph is the mean of the colours on the rays through it, also at borders."""
    scene, fine = build(furnished()), 8
    photo = Photographer(scene, CAMERA).take(pose).astype(float)
    seen = RayCaster(scene).fpv(pose, replace(CAMERA, fpv_px=fine * CAMERA.fpv_px))
    color = np.array([(0, 0, 0), *(instance.color for instance in scene.instances)])[seen.instance]

    def difference(down: int, right: int) -> np.ndarray:
        moved = np.roll(color, (down, right), axis=(0, 1))
        blocks = moved.reshape(CAMERA.fpv_px, fine, CAMERA.fpv_px, fine, 3)
        return np.abs(photo - blocks.mean(axis=(1, 3))).max(axis=-1)

    plain = ndimage.generic_filter(seen.instance[::fine, ::fine], np.ptp, 3) == 0
    assert plain.mean() > 0.7
    assert (difference(0, 0)[plain] < 1).mean() >= 0.995
    # a shift of a quarter of a pixel to any side is worse
    for move in ((2, 0), (-2, 0), (0, 2), (0, -2)):
        assert difference(*move).mean() > 1.2 * difference(0, 0).mean()


def picture(left: float, rows: int, columns: int, colors: list[tuple], repeats: int = 1) -> trimesh.Trimesh:
    """A square of 0.8 m, 2 m in front of `EASEL`, from `left` metres on; a repeated image of four quadrants."""
    corners = [(2, -left - across, 0.48 + up) for across, up in ((0, 0), (0.8, 0), (0.8, 0.8), (0, 0.8))]
    image = np.zeros((rows, columns, 3), np.uint8)
    for quadrant, color in zip(np.ndindex(2, 2), colors):
        image[tuple(slice(k * (n // 2), None) for k, n in zip(quadrant, image.shape))] = color
    material = PBRMaterial(baseColorTexture=Image.fromarray(image), doubleSided=False)
    visual = TextureVisuals(repeats * np.array([(0, 0), (1, 0), (1, 1), (0, 1)]), material=material)
    return trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], visual=visual, process=False)


EASEL = Pose(0, 0, 0, 0)


@pytest.mark.parametrize("atlas_px", [8192, 24, 8])
def test_each_texture_is_on_its_surface(atlas_px, monkeypatch):
    """Images of any width, in one atlas or several, once or repeated, keep their colours and positions."""
    monkeypatch.setattr(surfaces, "_ATLAS_PX", atlas_px)
    rng = np.random.default_rng(0)
    colors = rng.integers(0, 256, (4, 4, 3))
    places = [(-1.6, 10, 10, 1), (-0.8, 14, 6, 1), (0, 6, 18, 2), (0.8, 22, 10, 1)]
    meshes = [picture(left, rows, columns, c, n) for (left, rows, columns, n), c in zip(places, colors)]
    scene = replace(build(room(SIZE)), photograph=trimesh.Scene(meshes))
    camera = replace(CAMERA, fpv_px=256)
    photo = Photographer(scene, camera).take(EASEL).astype(int)
    for (left, _, _, repeats), quadrants in zip(places, colors):
        for down, right in np.ndindex(2 * repeats, 2 * repeats):
            x, y = (0.8 * (k + 0.5) / (2 * repeats) for k in (right, down))
            column, row = (
                camera.focal_px * at / 2 + camera.fpv_px / 2 for at in (left + x, camera.height_m - 1.28 + y)
            )
            shown, expected = photo[int(row), int(column)], quadrants[2 * (down % 2) + right % 2]
            assert np.abs(shown - expected).max() <= 1
    # no colour of a neighbour at the borders of the upper quadrants
    for (left, _, _, _), quadrants in zip(places, colors):
        row = int(camera.focal_px * (camera.height_m - 1.28 + 0.1) / 2 + camera.fpv_px / 2)
        for x, column_of in ((0.02, 0), (0.78, 1)):
            column = int(camera.focal_px * (left + x) / 2 + camera.fpv_px / 2)
            assert np.abs(photo[row, column] - quadrants[column_of]).max() <= 1


def test_photographers_of_two_scenes_and_sizes_take_turns():
    scenes = build(furnished()), build(room(SIZE))
    cameras = CAMERA, replace(CAMERA, fpv_px=20)
    alone = [Photographer(scene, camera).take(POSES[0]) for scene, camera in zip(scenes, cameras)]
    pair = [Photographer(scene, camera) for scene, camera in zip(scenes, cameras)]
    for _ in range(2):
        for photographer, expected in zip(pair, alone):
            assert np.array_equal(photographer.take(POSES[0]), expected)


def test_photographs_need_no_window_and_no_python_before_3_12():
    """Unpatched, pyrender and its pinned PyOpenGL fail on a minimal Debian and on Python 3.12."""
    assert surfaces.pyrender.viewer.pyglet.options.headless
    renamed = type("CArgObject", (), {"__module__": "_ctypes"})  # as Python 3.12 calls what `ctypes.byref` gives
    assert FormatHandler.match(renamed) is not None
