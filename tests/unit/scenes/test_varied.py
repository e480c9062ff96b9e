"""Varied homes: what they share with flats, and how they differ from each other."""

from dataclasses import replace

import numpy as np
import pytest

from zerobev.common.errors import InputError
from zerobev.config import LABELS, AgentConfig, CameraConfig, SceneConfig
from zerobev.geometry.cameras import Pose
from zerobev.geometry.projection import fov_mask
from zerobev.rendering.gbuffer import RayCaster
from zerobev.rendering.poses import navigable_floor
from zerobev.scenes.homes import ensure_home, home_folders
from zerobev.scenes.indoor import fixtures, generate_home
from zerobev.scenes.indoor.atlas import CHART_PX
from zerobev.scenes.indoor.home import build_home
from zerobev.scenes.indoor.plan import HALLS, along, floor_before, overlap
from zerobev.scenes.indoor.space import Space
from zerobev.scenes.indoor.style import draw_style
from zerobev.scenes.readers import read_scene

from support.indoor import DESIGNS, OTHERS, plan, surplus_edges, triangles

CAMERA = CameraConfig(fpv_px=32, bev_px=20)
FLATS = SceneConfig(train=2, validation=1, test=1, views=1)


@pytest.fixture(scope="module")
def names():
    """Names of instances of flats and of all designs, and of structures of halls."""
    flats = {name for seed in range(8) for name in build_home(np.random.default_rng(seed)).names}
    designs = (*sum(DESIGNS.values(), ()), *OTHERS)
    furniture = {name for design in designs for name, _ in design(np.random.default_rng(0)).items}
    return flats | furniture | {"column", "beam"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_a_home_has_closed_solids_and_a_floor_with_views(seed, names):
    home = build_home(np.random.default_rng(seed), "varied")
    scene = generate_home("Varied0000000", np.random.default_rng(seed), "varied")
    assert set(home.names) <= names
    for index, name in enumerate(home.names, start=1):
        assert name == "ceiling" or surplus_edges(triangles(home.quads[home.owner == index])) == 0, name
    assert all(rows <= CHART_PX and columns <= CHART_PX for rows, columns in (i.shape for i in scene.chart_instance))
    np.testing.assert_array_equal(scene.face_instance, home.owner[scene.faces[:, 0] // 4])
    rng = np.random.default_rng(0)
    floor, caster = navigable_floor(scene, AgentConfig(), rng), RayCaster(scene)
    assert floor.area_m2 > 5
    assert np.abs(floor.cells[:, 2]).max() < 0.02  # rugs
    views = [fov_mask(caster.fpv(floor.draw(rng), CAMERA).distance, CAMERA).mean() for _ in range(40)]
    assert np.mean(np.array(views) >= 0.1) > 0.5


def test_walls_on_the_map_have_textures():
    """The cut at 2 m is below the tops of doors; walls have a texel per centimetre there, nearly one per cell."""
    doors = [opening for room in plan("varied", 3) for opening in room.openings if not opening.window]
    assert min(door.head for door in doors) > 2.0
    scene = generate_home("Varied0000000", np.random.default_rng(3), "varied")
    rng = np.random.default_rng(0)
    floor, caster = navigable_floor(scene, AgentConfig(), rng), RayCaster(scene)
    for _ in range(5):
        found = caster.bev(floor.draw(rng), CAMERA)
        wall = (scene.instance_label[found.instance] == LABELS.index("wall")) & (found.distance > 1.9)
        assert wall.sum() > 5
        assert len(np.unique(found.atlas[wall])) > 0.8 * wall.sum()


@pytest.mark.slow
def test_columns_are_on_the_map_also_below_beams():
    scene = generate_home("Varied0000000", np.random.default_rng([0, 140]), "varied")
    columns = [instance.id for instance in scene.instances if instance.name == "column"]
    assert columns and "beam" in {instance.name for instance in scene.instances}
    caster, camera = RayCaster(scene), CameraConfig(fpv_px=8, bev_px=50)
    for column in columns:
        (x0, y0, _), (x1, y1, _) = scene.instance_bounds[column]
        found = caster.bev(Pose((x0 + x1) / 2, (y0 + y1) / 2 - 1.0, 0.0, np.pi / 2), camera)
        assert (found.instance == column).sum() * camera.cell_m**2 > 0.7 * (x1 - x0) * (y1 - y0)


def test_all_kinds_of_buildings_and_styles_occur():
    """Over the seeds of a small set of homes."""
    plans = [plan("varied", seed) for seed in range(120)]
    rooms = [room for rooms in plans for room in rooms]
    assert {room.kind for room in rooms} >= set(HALLS)
    halls = [room.area for room in rooms if room.kind in HALLS]
    assert min(halls) < 50 and max(halls) > 110
    sides = [sorted((r.inner[2] - r.inner[0], r.inner[3] - r.inner[1])) for r in rooms if r.kind == "hall"]
    corridors = [long for short, long in sides if 1.2 <= short <= 2.3]
    assert min(corridors) < 8 and max(corridors) > 16
    assert min(room.height for room in rooms) < 2.4 and max(room.height for room in rooms) > 3.4
    openings = [(room, opening) for room in rooms for opening in room.openings]
    assert any(not opening.window and opening.head == room.height for room, opening in openings)  # passages
    assert any(opening.window and opening.end - opening.start > 6 for _, opening in openings)  # glass fronts

    styles = [draw_style(np.random.default_rng(seed)) for seed in range(120)]
    assert min(style.kept for style in styles) < 0.2 and max(style.extra for style in styles) > 0.4
    assert {style.baked for style in styles} == {False, True}
    keys = [style.key for style in styles if style.key]
    assert min(keys) < 0.06 and max(keys) > 0.6
    assert sum(style.cast != (1, 1, 1) for style in styles) > 5 < sum(style.contrast == 0 for style in styles)


def test_halls_have_columns_and_beams_apart_from_doors():
    found = set()
    for seed in range(40):
        for hall in (room for room in plan("varied", seed) if room.kind in HALLS):
            space = Space(np.random.default_rng(seed), hall)
            fixtures.structure(space)
            found |= {name for name, _ in space.items}
            doors = [floor_before(hall, o.side, *along(hall, o), 0.7) for o in hall.openings if not o.window]
            for name, solid in space.items:
                footprint = (*solid.bounds[0, :2], *solid.bounds[1, :2])
                assert name != "column" or not any(overlap(footprint, door) for door in doors)
    assert found == {"column", "beam", "ceiling lamp"}


@pytest.mark.slow
def test_brightness_of_photographs_follows_the_style():
    """The median of large surfaces; a dark home is dark, a bright one bright."""
    shades = []
    for seed in range(12):
        style = draw_style(np.random.default_rng(seed))
        if style.key and not 0.1 < style.key < 0.35:
            scene = generate_home("home", np.random.default_rng(seed), "varied")
            textures = [np.asarray(m.visual.material.baseColorTexture) for m in scene.photograph.geometry.values()]
            shown = np.concatenate([texture[image > 0] for texture, image in zip(textures, scene.chart_instance)])
            shades.append((style.key, float(np.median(shown.mean(axis=1)))))
    assert len(shades) >= 3
    for key, shade in shades:
        assert (shade < 110) == (key < 0.1)


def test_kinds_of_homes_have_their_own_folders_and_maps(tmp_path):
    """A varied home is written by its name, and its map is that of a real home."""
    folders = home_folders(tmp_path, replace(FLATS, homes="varied"))
    assert [folder.name for folder in folders.train] == ["00000-Varied0000000", "00001-Varied0000001"]
    assert home_folders(tmp_path, FLATS).test[0].name == "01000-Home0001000"
    scene = read_scene(ensure_home(folders.train[0], 3))
    assert not scene.generated
    expected = build_home(np.random.default_rng([3, 0]), "varied")
    assert [instance.name for instance in scene.instances] == expected.names
    with pytest.raises(InputError, match="homes: expected one of flats, varied, found 'caves'"):
        replace(FLATS, homes="caves")
