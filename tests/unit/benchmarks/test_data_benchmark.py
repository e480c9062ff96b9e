"""Rendered pairs equal looked-up pairs, and figures of the benchmark follow from its measurements."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from zerobev.benchmarks import data as benchmark
from zerobev.benchmarks.data import noise_bank, texture_images
from zerobev.config import CameraConfig, Scale, scale
from zerobev.geometry.cameras import Pose
from zerobev.rendering.gbuffer import RayCaster
from zerobev.rendering.rerender import Rerenderer
from zerobev.scenes.hm3dsem_writer import write_scene
from zerobev.scenes.scene import Scene

from support.scenes import build, furnished

CAMERA = CameraConfig(fpv_px=64, bev_px=50)
POSES = (Pose(2.0, 0.5, 0, 1.0), Pose(4.4, 2.4, 0, -2.9), Pose(0.6, 3.5, 0, -0.7))


@pytest.fixture(scope="module")
def setting() -> Scale:
    """The smoke scale with another camera."""
    return replace(scale("smoke"), camera=CAMERA)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build(furnished())


def test_a_rendered_pair_is_the_looked_up_pair(scene, setting):
    bank, caster, rerenderer = noise_bank(setting, 0.2), RayCaster(scene), Rerenderer(scene, CAMERA)
    agree = {"fpv": [], "bev": [], "another": []}
    for seed, pose in enumerate(POSES):
        draw = bank.draw(np.random.default_rng(seed), len(scene.chart_instance))
        rerenderer.set_texture(texture_images(scene, bank, np.random.default_rng(seed)))
        zero, _ = rerenderer.fpv(pose)
        looked_up = bank.look_up(caster.fpv(pose, CAMERA).texel, draw)
        agree["fpv"].append((zero == looked_up).mean())
        agree["bev"].append((rerenderer.bev(pose) == bank.look_up(caster.bev(pose, CAMERA).texel, draw)).mean())
        rerenderer.set_texture(texture_images(scene, bank, np.random.default_rng(seed + 10)))
        agree["another"].append((rerenderer.fpv(pose)[0] == looked_up).mean())
    assert np.mean(agree["fpv"]) > 0.97 and np.mean(agree["bev"]) > 0.97  # except edges of squares
    assert np.mean(agree["another"]) < 0.85


def test_rendered_depth_is_the_cast_one(scene):
    rerenderer = Rerenderer(scene, CAMERA)
    rerenderer.set_texture([np.zeros(image.shape, bool) for image in scene.chart_instance])
    for pose in POSES:
        cast = RayCaster(scene).fpv(pose, CAMERA).distance
        # samples of the rasteriser and rays differ by up to half a pixel
        near = [filter_(cast, size=3) for filter_ in (ndimage.minimum_filter, ndimage.maximum_filter)]
        depth = rerenderer.fpv(pose)[1]
        between = (depth > 0.99 * near[0]) & (depth < 1.01 * near[1])
        assert between[1:-1, 1:-1].mean() > 0.995


def test_white_fraction_of_a_noise_bank(setting):
    for white in benchmark.DENSITIES:
        assert noise_bank(setting, white).tiles.mean() == pytest.approx(white, abs=0.01)


@pytest.fixture
def measured(scene, setting, monkeypatch) -> dict:
    """The measurements of a hand-made home, after a round trip through JSON."""

    def folder(root, number):
        write_scene(root / f"{number:05d}-Home", scene)
        return root / f"{number:05d}-Home"

    monkeypatch.setattr(benchmark, "home_folder", folder)
    monkeypatch.setattr(benchmark, "WORKERS", (1,))
    monkeypatch.setattr(benchmark, "_STORED", 3)
    found = benchmark.measure(setting, repeats=3, seconds=0.1)
    return json.loads(json.dumps(found)) | {"printed": "\n".join(benchmark.table(found))}


def test_figures_follow_from_the_measurements(measured):
    views, pairs = measured["by_workers"]["1"], measured["by_kind"]
    assert measured["views_per_s"] == views["median"] > 0
    assert measured["pairs_per_s"] == pairs["looked_up"]["synth 0.2"]["median"] > 0
    kinds = {"synth 0.1", "synth 0.15", "synth 0.2", "synth 0.25", "synth 0.3", "mod sem", "depth proj"}
    assert set(pairs["looked_up"]) == set(pairs["rendered"]) == kinds
    for rate in (views, pairs["ratio"], pairs["tuples"], *pairs["looked_up"].values(), *pairs["rendered"].values()):
        assert 0 < rate["low"] <= rate["median"] <= rate["high"]
    look_up_s, render_s = (sum(1 / r["median"] for r in pairs[how].values()) for how in ("looked_up", "rendered"))
    assert pairs["ratio"]["low"] / 2 < render_s / look_up_s < pairs["ratio"]["high"] * 2
    assert measured["ratio_to_rerendering"] == pairs["ratio"]["median"]
    assert measured["ratio_with_views"] == pytest.approx(render_s / (1 / views["median"] + look_up_s))
    count = scale("smoke").scenes.views
    assert measured["generated_views_per_s"] == pytest.approx(count / (views["set_up_s"] + count / views["median"]))
    for number in (measured["views_per_s"], measured["ratio_to_rerendering"], measured["generated_views_per_s"]):
        assert f"{number:,.1f}" in measured["printed"]
