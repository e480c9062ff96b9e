"""Photographs of glTF materials, against closed forms: factors, vertex colours, alpha, wrap modes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import Pose
from zerobev.rendering.photograph import Photographer
from zerobev.scenes.glb import read_glb
from zerobev.scenes.gltf import CLAMP, MIRROR, REPEAT
from zerobev.scenes.hm3dsem_writer import write_scene

from support.glb import GlbFile, encoded
from support.scenes import build, room

EYE = Pose(0, 0, 0, 0)
CAMERA = CameraConfig(fpv_px=64, bev_px=40)
UV = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], float)
WALL = (200, 30, 40)


def pane(distance: float, half: float = 4.0) -> np.ndarray:
    """(4, 3) corners of a square in front of `EYE`, counter-clockwise from its lower left."""
    height = CAMERA.height_m
    sides = [(1, -1), (-1, -1), (-1, 1), (1, 1)]
    return np.array([(distance, half * left, height + half * up) for left, up in sides])


def plain(color: tuple[int, ...]) -> bytes:
    return encoded(np.full((4, 4, len(color)), color, np.uint8))


def photo(glb: GlbFile, path: Path, lit: bool = False) -> np.ndarray:
    scene = replace(build(room((1, 1, 1))), photograph=read_glb(glb.save(path / "a.glb")), unlit=not lit)
    return Photographer(scene, CAMERA).take(EYE).astype(int)


def centre(image: np.ndarray) -> np.ndarray:
    return image[28:36, 28:36].mean(axis=(0, 1))


def before_a_wall() -> GlbFile:
    glb = GlbFile()
    glb.place(glb.quad(pane(5), UV, glb.material(plain(WALL))))
    return glb


def linear(srgb: np.ndarray) -> np.ndarray:
    srgb = np.asarray(srgb) / 255
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb(color: np.ndarray) -> np.ndarray:
    color = np.asarray(color)
    return 255 * np.where(color <= 0.0031308, color * 12.92, 1.055 * color ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("textured", [True, False])
@pytest.mark.parametrize(("kind", "width"), [("u1", 3), ("u2", 4), ("f4", 3), ("f4", 4), (None, 0)])
def test_factors_multiply_in_linear_light(tmp_path: Path, textured: bool, kind: str | None, width: int) -> None:
    factor = np.array([0.5, 0.02, 0.3])
    glb = GlbFile()
    material = glb.material(plain(WALL) if textured else None, factor=[*factor, 0.1])
    expected = factor * (linear(WALL) if textured else 1)
    more = {}
    if kind is not None:
        color = np.array([0.7, 0.4, 0.09, 0.2])[:width]
        most = 1 if kind == "f4" else np.iinfo(kind).max
        stored = np.tile(color * most, (4, 1))
        more["COLOR_0"] = glb.array(stored if kind == "f4" else np.rint(stored), kind, normalized=kind != "f4")
        expected = expected * color[:3]
    glb.place(glb.quad(pane(3), UV, material, **more))
    np.testing.assert_allclose(centre(photo(glb, tmp_path)), srgb(expected), atol=2)


def test_untextured_vertex_colors_without_a_material(tmp_path: Path) -> None:
    glb = GlbFile()
    primitive = glb.quad(pane(3), UV, 0, COLOR_0=glb.array(np.tile([0.5, 0.01, 0.2], (4, 1))))
    del primitive["material"]
    glb.place(primitive)
    np.testing.assert_allclose(centre(photo(glb, tmp_path)), srgb([0.5, 0.01, 0.2]), atol=1)


@pytest.mark.parametrize("lit", [False, True])
@pytest.mark.parametrize(
    ("alpha", "cutoff", "seen"),
    [(0, None, False), (127, None, False), (129, None, True), (200, 0.8, False), (210, 0.8, True), (0, 0.0, True)],
)
def test_masks_are_open_or_closed(tmp_path: Path, alpha: int, cutoff: float | None, seen: bool, lit: bool) -> None:
    """A masked pane hides the wall behind it if alpha reaches the cutoff, else it is invisible."""
    glb = before_a_wall()
    more = {} if cutoff is None else {"alphaCutoff": cutoff}
    glb.place(glb.quad(pane(3), UV, glb.material(plain((20, 60, 220, alpha)), alphaMode="MASK", **more)))
    found = centre(photo(glb, tmp_path, lit))
    assert (found[2] > found[0]) == seen
    if not lit:
        np.testing.assert_allclose(found, (20, 60, 220) if seen else WALL, atol=1)


def test_opaque_materials_ignore_alpha(tmp_path: Path) -> None:
    glb = before_a_wall()
    material = glb.material(plain((20, 60, 220, 0)), factor=[1, 1, 1, 0])
    glb.place(glb.quad(pane(3), UV, material, COLOR_0=glb.array(np.tile([1, 1, 1, 0], (4, 1)))))
    np.testing.assert_allclose(centre(photo(glb, tmp_path)), (20, 60, 220), atol=1)


@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize("order", [(2, 3), (3, 2)])
def test_the_room_is_visible_through_glass(tmp_path: Path, order: tuple[int, int], merged: bool) -> None:
    """Two panes, in either order and of one primitive or two: the farther is visible through the nearer."""
    alpha = {2: 0.25, 3: 0.5}
    colors = {2: np.array([0, 255, 0]), 3: np.array([0, 0, 255])}
    glb = before_a_wall()
    image = np.array([[(*colors[d], 255 * alpha[d]) for d in (2, 2, 3, 3)]] * 2).astype(np.uint8)
    material = glb.material(encoded(image), alphaMode="BLEND")
    panes = [(pane(d), np.full((4, 2), (0.25 if d == 2 else 0.75, 0.5))) for d in order]
    if merged:
        corners, uv = (np.concatenate(arrays) for arrays in zip(*panes))
        primitive = glb.quad(corners, uv, material)
        primitive["indices"] = glb.array([0, 1, 2, 0, 2, 3, 4, 5, 6, 4, 6, 7], "u2")
        glb.place(primitive)
    else:
        for corners, uv in panes:
            glb.place(glb.quad(corners, uv, material))
    expected = np.array(WALL)
    for distance in (3, 2):
        expected = alpha[distance] * colors[distance] + (1 - alpha[distance]) * expected
    np.testing.assert_allclose(centre(photo(glb, tmp_path)), expected, atol=2)


@pytest.mark.parametrize("mode", [CLAMP, REPEAT, MIRROR])
def test_wrap_modes_and_texture_transforms(tmp_path: Path, mode: int) -> None:
    """A texture with coordinates beyond its image looks like an image with baked wrapping."""
    image = np.random.default_rng(0).integers(0, 256, (2, 4, 3), np.uint8).repeat(16, axis=0).repeat(16, axis=1)
    baked = np.pad(image, ((32, 32), (64, 64), (0, 0)), mode={CLAMP: "edge", REPEAT: "wrap", MIRROR: "symmetric"}[mode])
    seen = {}
    for name in ("wrapped", "baked"):
        glb = GlbFile()
        if name == "wrapped":
            info = {"extensions": {"KHR_texture_transform": {"offset": [-1, -1], "scale": [3, 3]}}}
            material = glb.material(encoded(image), {"wrapS": mode, "wrapT": mode}, info=info)
        else:
            material = glb.material(encoded(baked))
        glb.place(glb.quad(pane(3, 1.5), UV, material))
        seen[name] = photo(glb, tmp_path)
    difference = np.abs(seen["wrapped"] - seen["baked"])  # texture units round coordinates at borders
    assert difference.mean() < 0.1
    assert difference.max() <= 10
    assert seen["baked"].std() > 20


def test_materials_survive_writing(tmp_path: Path) -> None:
    """A scene that is read and written again looks the same."""
    glb = before_a_wall()
    tint = glb.array(np.tile([0.8, 0.9, 1], (4, 1)))
    glass = glb.material(plain((250, 250, 250, 90)), alphaMode="BLEND", factor=[0.5, 1, 1, 0.9])
    glb.place(glb.quad(pane(3), UV, glass, COLOR_0=tint))
    mask = glb.material(plain((20, 60, 220, 100)), alphaMode="MASK", alphaCutoff=0.2)
    glb.place(glb.quad(pane(4, 1.0), UV, mask))
    scene = replace(build(room((1, 1, 1))), photograph=read_glb(glb.save(tmp_path / "a.glb")))
    write_scene(tmp_path / "00001-Test", scene)
    back = replace(scene, photograph=read_glb(tmp_path / "00001-Test/Test.glb"))
    before, after = (Photographer(one, CAMERA).take(EYE).astype(int) for one in (scene, back))
    assert np.abs(before - after).max() <= 4
    assert before.std() > 10
