"""Rates of views and of pairs (I_zero, M_zero).

Pairs are made by look-up in stored views, and by rendering: the texture is uploaded to the mesh, and the mesh is
rendered from both cameras. Rates depend on machine and time; the ratios, with their spread, carry over.
"""

import itertools
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch

from zerobev.config import CameraConfig, Scale
from zerobev.data.samples import DepthProjSamples, ModSemSamples, SampleStream, SynthSamples
from zerobev.data.shards import Shard, write_shard
from zerobev.data.textures import TextureBank, modsem_textures, random_rectangles
from zerobev.data.view_set import ViewSet
from zerobev.data.views import View, ViewSource
from zerobev.geometry.cameras import Pose
from zerobev.geometry.projection import inverse_project_mask
from zerobev.rendering.rerender import Rerenderer
from zerobev.scenes.hm3dsem_writer import write_scene
from zerobev.scenes.indoor import generate_home
from zerobev.scenes.readers import read_scene
from zerobev.scenes.scene import Scene

DENSITIES = (0.10, 0.15, 0.20, 0.25, 0.30)  #: fractions of white texels (paper, Table 4)
WORKERS = (1, 2)
_STORED = 24  # views for pairs


def home_folder(root: Path, number: int) -> Path:
    """A generated home, written below `root`."""
    folder = root / f"{number:05d}-Home{number:07d}"
    write_scene(folder, generate_home(folder.name, np.random.default_rng(number)))
    return folder


def view_rates(folder: Path, setting: Scale, repeats: int, seconds: float) -> tuple[float, np.ndarray]:
    """Rate of one worker that draws complete views of a home.

    Returns the seconds from the home's folder to its first view, and (repeats, 2) views per second of wall time and of
    processor time, measured for `seconds` each.
    """
    torch.set_num_threads(1)
    _views(folder, setting)  # imports, and shaders, compiled once per process
    start = time.perf_counter()
    _, source = _views(folder, setting)
    set_up = time.perf_counter() - start
    rates = np.empty((repeats, 2))
    for rate in rates:
        drawn, wall, processor = 0, time.perf_counter(), time.process_time()
        while time.perf_counter() - wall < seconds:
            source.draw()
            drawn += 1
        rate[:] = drawn / (time.perf_counter() - wall), drawn / (time.process_time() - processor)
    return set_up, rates


def measure_views(folders: list[Path], setting: Scale, repeats: int, seconds: float) -> dict[str, Any]:
    """Views per second of one and of two workers, each with its own home.

    The rate in processor time is that of one otherwise idle core.
    """
    measured: dict[str, Any] = {}
    for workers in WORKERS:
        jobs = (joblib.delayed(view_rates)(folder, setting, repeats, seconds) for folder in folders[:workers])
        set_up, rates = zip(*joblib.Parallel(n_jobs=workers)(jobs))
        wall, processor = np.moveaxis(np.array(rates), -1, 0)
        measured[str(workers)] = spread(wall.sum(axis=0)) | {
            "set_up_s": float(np.median(set_up)),
            "per_processor_s": float(np.median(processor)),
        }
    return measured


def measure_pairs(folder: Path, shard: Path, setting: Scale, repeats: int) -> dict[str, Any]:
    """Pairs per second by look-up and by rendering, per kind of texture and interleaved, and their ratio.

    Views are stored and textures are uploaded before the measurement. The upload is measured separately: the paper
    needs one per scene, a fresh texture per pair needs one per pair.
    """
    torch.set_num_threads(1)
    views, scene = stored_views(folder, shard, setting, _STORED), read_scene(folder)
    stored = [views.locate(index)[1] for index in range(len(views))]
    banks = {f"synth {white:g}": noise_bank(setting, white) for white in DENSITIES}
    streams: dict[str, SampleStream] = {
        name: SynthSamples(views, bank, setting.camera, seed=0, batch=1) for name, bank in banks.items()
    }
    streams["mod sem"] = ModSemSamples(views, setting.camera, seed=0, batch=1)
    streams["depth proj"] = DepthProjSamples(views, setting.camera, seed=0, batch=1)
    rng = np.random.default_rng(0)
    textures = {name: texture_images(scene, bank, rng) for name, bank in banks.items()}
    textures["mod sem"] = [modsem_textures(chart, setting.texture, rng, 1)[0] for chart in scene.chart_instance]
    rerenderer = Rerenderer(scene, setting.camera)
    looked_up: dict[str, list[float]] = defaultdict(list)
    rendered: dict[str, list[float]] = defaultdict(list)
    uploads: list[float] = []
    for _, (name, stream) in itertools.product(range(repeats), streams.items()):
        looked_up[name].append(_seconds_each(stored, stream.pair, 0, rng))
        if name in textures:
            rerenderer.set_texture(textures[name])
            first, again = (_seconds_each(stored[:1], lambda view: rerenderer.fpv(Pose(*view.pose))) for _ in range(2))
            uploads.append(first - again)
        rendered[name].append(_seconds_each(stored, rerender, name in textures, rerenderer, setting.camera, rng))
    look_up_s, render_s = (np.mean(list(kinds.values()), axis=0) for kinds in (looked_up, rendered))
    samples = [1 / _seconds_each(range(_STORED), streams["synth 0.2"].sample) for _ in range(repeats)]
    return {
        "looked_up": {name: spread(1 / np.array(seconds)) for name, seconds in looked_up.items()},
        "rendered": {name: spread(1 / np.array(seconds)) for name, seconds in rendered.items()},
        "put_on_s": spread(uploads),
        # of all kinds, with the same number of pairs of each
        "ratio": spread(render_s / look_up_s),
        "tuples": spread(samples),
    }


def stored_views(folder: Path, shard: Path, setting: Scale, count: int) -> ViewSet:
    """Views of a home, written to `shard`."""
    scene, source = _views(folder, setting)
    write_shard(shard, scene, (source.draw() for _ in range(count)), setting.camera, setting.texture, 0)
    return ViewSet([Shard(shard, setting.camera, setting.texture)])


def synth_stream(views: ViewSet, setting: Scale, samples: int) -> SynthSamples:
    """Training data of a scale in batches of `samples`, with textures of `noise_bank`."""
    bank, empty = noise_bank(setting, setting.texture.white_fraction), setting.empty_fraction
    return SynthSamples(views, bank, setting.camera, 0, samples, empty, extruded_fraction=setting.extruded_fraction)


def noise_bank(setting: Scale, white_fraction: float) -> TextureBank:
    """A bank of the scale's size, at most 32 tiles, of random squares; structures do not affect the look-up's time."""
    texture = replace(setting.texture, white_fraction=white_fraction, tiles=min(setting.texture.tiles, 32))
    side = texture.tile_px // 16
    squares = np.random.default_rng(0).random((texture.tiles, side, side)) < white_fraction
    return TextureBank(squares.repeat(16, axis=1).repeat(16, axis=2), texture)


def texture_images(scene: Scene, bank: TextureBank, rng: np.random.Generator) -> list[np.ndarray]:
    """A texture of `bank` on the charts of a scene: one (rows, columns) bool image per chart."""
    draw = bank.draw(rng, len(scene.chart_instance))
    return [
        bank.look_up(np.stack([np.full(image.shape, chart), *np.indices(image.shape)], axis=-1).astype(np.int16), draw)
        for chart, image in enumerate(scene.chart_instance)
    ]


def rerender(
    view: View, textured: bool, rerenderer: Rerenderer, camera: CameraConfig, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The pair (I_zero, M_zero) at the pose of `view`, of the texture on the mesh; not `textured`: of *Depth proj.*."""
    pose = Pose(*view.pose)
    zero, depth = rerenderer.fpv(pose)
    if textured:
        return zero, rerenderer.bev(pose)
    zero = random_rectangles(depth.shape, rng)
    return zero, inverse_project_mask(zero, np.ascontiguousarray(depth, np.float32), camera)


def spread(values: Iterable[float]) -> dict[str, float]:
    """Median, minimum and maximum of the repeats."""
    values = np.asarray(values, float)
    return {"median": float(np.median(values)), "low": float(values.min()), "high": float(values.max())}


def report(setting: Scale, views: dict[str, Any], pairs: dict[str, Any]) -> dict[str, Any]:
    """All measurements, with the figures of interest at the top level."""
    kinds, workers = len(pairs["looked_up"]), WORKERS[-1]
    look_up_s, render_s = (np.mean([1 / r["median"] for r in pairs[how].values()]) for how in ("looked_up", "rendered"))
    drawing_s = setting.scenes.views / (views[str(workers)]["median"] / workers)
    return {
        "scale": setting.name,
        "views_per_s": views[str(workers)]["median"],
        "pairs_per_s": pairs["looked_up"]["synth 0.2"]["median"],
        "ratio_to_rerendering": pairs["ratio"]["median"],
        # with a fresh texture per pair, as in our training
        "ratio_to_fresh_rerendering": (render_s + pairs["put_on_s"]["median"]) / look_up_s,
        # with the time of the views, once for all kinds
        "ratio_with_views": kinds * render_s / (1 / views["1"]["median"] + kinds * look_up_s),
        "tuples_per_s": pairs["tuples"]["median"],
        # with the reading and preparation of homes, and the scale's number of views per home
        "generated_views_per_s": workers * setting.scenes.views / (views[str(workers)]["set_up_s"] + drawing_s),
        "by_workers": views,
        "by_kind": pairs,
    }


def table(measured: dict[str, Any]) -> list[str]:
    """The report as lines of text: medians, with the range of the repeats in brackets."""
    pairs = measured["by_kind"]
    rows = [(f"complete views, workers: {workers}", rate) for workers, rate in measured["by_workers"].items()]
    rows += [(f"pairs by look-up, {name}", rate) for name, rate in pairs["looked_up"].items()]
    rows += [(f"pairs by rendering, {name}", rate) for name, rate in pairs["rendered"].items()]
    rows += [("tuples, read from the shard", pairs["tuples"])]
    lines = [f"{what:<34}{r['median']:>10,.1f} /s  [{r['low']:,.1f}, {r['high']:,.1f}]" for what, r in rows]
    ratio = pairs["ratio"]
    return [
        f"scale {measured['scale']}: median [smallest, largest] of the repeats",
        *lines,
        f"{'complete views, one whole core':<34}{measured['by_workers']['1']['per_processor_s']:>10,.1f} /s",
        f"{'views, homes read and prepared':<34}{measured['generated_views_per_s']:>10,.1f} /s",
        f"{'look-up against rendering':<34}{ratio['median']:>10,.1f} x   [{ratio['low']:,.1f}, {ratio['high']:,.1f}]",
        f"{'  another texture for every pair':<34}{measured['ratio_to_fresh_rerendering']:>10,.1f} x",
        f"{'  the time of the views included':<34}{measured['ratio_with_views']:>10,.1f} x",
    ]


def measure(setting: Scale, repeats: int, seconds: float) -> dict[str, Any]:
    """All measurements, in homes generated for them, `repeats` times; views for `seconds` each."""
    with tempfile.TemporaryDirectory() as folder:
        folders = [home_folder(Path(folder), number) for number in range(max(WORKERS))]
        views = measure_views(folders, setting, repeats, seconds)
        pairs = measure_pairs(folders[0], Path(folder) / "views.h5", setting, repeats)
    return report(setting, views, pairs)


def _views(folder: Path, setting: Scale) -> tuple[Scene, ViewSource]:
    """A home and the source of its views, after the first view."""
    scene = read_scene(folder)
    source = ViewSource(scene, setting.camera, setting.texture, np.random.default_rng(0))
    source.draw()
    return scene, source


def _seconds_each(items: Sequence[Any], make: Callable, *arguments: Any) -> float:
    start = time.perf_counter()
    for item in items:
        make(item, *arguments)
    return (time.perf_counter() - start) / len(items)
