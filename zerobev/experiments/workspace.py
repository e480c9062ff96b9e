"""The data of one scale on this machine: scenes, views and textures, made at their first use.

Data lie in the ignored folder `.cache` and can be made again; results lie in `reports`.
"""

import argparse
import os
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from zerobev import config
from zerobev.common.errors import InputError
from zerobev.common.keys import fingerprint
from zerobev.common.locks import locked
from zerobev.common.parallel import run_jobs
from zerobev.common.paths import report_name, zerobev_home
from zerobev.common.settings import changed_by
from zerobev.common.storage import replacing
from zerobev.config import SCALES, SPLITS, AugmentConfig, CameraConfig, Split, TextureConfig
from zerobev.data.augment import Augmentation
from zerobev.data.generate import generate, shard_path
from zerobev.data.patterns import SourceImages
from zerobev.data.shards import Shard, recorded_with
from zerobev.data.textures import TextureBank
from zerobev.data.view_set import ViewSet
from zerobev.data.visibility import shard_visibility
from zerobev.experiments import versions
from zerobev.scenes.hm3dsem import SceneFolders
from zerobev.scenes.homes import ensure_home, ensure_homes, home_folders
from zerobev.scenes.readers import read_scene, split_scenes
from zerobev.scenes.scene import Scene
from zerobev.training.distributed import rank_and_world_size


def add_workspace_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of a command that choose its workspace."""
    parser.add_argument("--scale", default="reduced", help=f"one of {', '.join(SCALES)} (default: reduced)")
    parser.add_argument("--scenes", default="", metavar="DIR", help="HM3DSem scenes instead of generated homes")


class Workspace:
    """Scenes, views and textures of a scale, from generated homes or from a folder of scenes."""

    def __init__(self, scale: str, scenes: str = "", root: Path | None = None, settings: Sequence[str] = ()) -> None:
        """Choose scale and scenes; nothing is made yet.

        scale: a name in `config.SCALES`
        scenes: a folder in HM3DSem layout; "" for generated homes
        root: the folder of `.cache` and `reports`; default: `common.paths.zerobev_home()`
        settings: changed values of the scale, such as `train.steps=2400`, see `common.settings`
        Raises `InputError` for an unknown scale or setting, or a missing folder.
        """
        root = root or zerobev_home()
        self._arguments = scale, scenes, root
        self.has_settings = bool(settings)
        self.scale = changed_by(config.scale(scale), settings)
        self.source = Path(scenes).expanduser().resolve() if scenes else None
        if self.source and not self.source.is_dir():
            raise InputError(f"scenes: expected a folder in HM3DSem layout, found nothing at {scenes}")
        self.reports = root / "reports" / report_name(scale, self.source)
        textures = os.environ.get("ZEROBEV_TEXTURES")  # set by `make reproduce TEXTURES=...`
        self._textures = Path(textures) if textures else None
        self.cache = root / ".cache"
        self._workers = os.cpu_count() or 1

    def without_settings(self) -> "Workspace":
        """The same workspace with the scale's own values."""
        return Workspace(*self._arguments)

    @cached_property
    def data_config(self) -> dict[str, Any]:
        """Everything that the views depend on; part of the configuration of every run."""
        found = {
            "version": versions.DATA,
            **recorded_with(self.scale.camera, self.scale.texture),
            "scenes": self.scale.scenes,
        }
        if self.source:
            folders = {folder for split in SPLITS for folder in self.split.of(split)}
            files = sorted(file for folder in folders for file in folder.iterdir() if file.is_file())
            found["source"] = {f"{file.parent.name}/{file.name}": file.stat().st_size for file in files}
        return found

    def texture_config(self, texture: TextureConfig) -> dict[str, Any]:
        """Everything that a texture bank depends on."""
        source = self._textures.name if self._textures else "procedural"
        return {"version": versions.DATA, "sources": source, "texture": texture}

    @property
    def runs(self) -> Path:
        """Folder of checkpoints and logs."""
        return self.cache / "runs" / self.reports.name

    def alone(self, key: str) -> AbstractContextManager[None]:
        """Lock the folder of a run for this launch, see `common.locks.locked`; rank 0 holds the lock for all ranks."""
        return locked(self.runs / key, "process with this run") if rank_and_world_size()[0] == 0 else nullcontext()

    @cached_property
    def views_folder(self) -> Path:
        """Folder of the shards, with a folder per split."""
        return self.cache / f"views-{fingerprint(self.data_config)}"

    @property
    def split(self) -> SceneFolders:
        """Folders of the training, validation and test scenes; those of generated homes may not exist yet."""
        if self.source:
            return split_scenes(self.source)
        scenes = self.scale.scenes
        kind = "" if scenes.homes == "flats" else f"{scenes.homes}-"
        return home_folders(self.cache / f"homes-{kind}{versions.DATA}-{scenes.seed}", scenes)

    def scene(self, split: Split, index: int) -> Scene:
        """Scene number `index` of a split."""
        folder = self.split.of(split)[index]
        if not self.source:
            ensure_home(folder, self.scale.scenes.seed)
        return read_scene(folder)

    def views(self, split: Split, scenes: int | None = None) -> ViewSet:
        """Views of the first `scenes` scenes of a split (default: all); missing shards are made now.

        Raises `InputError` with the scenes that failed.
        """
        folders = list(self.split.of(split)[:scenes])
        seed = self.scale.scenes.seed + config.SPLITS.index(split)
        out = self.views_folder / split
        if not all(shard_path(folder, out).exists() for folder in folders):
            if not self.source:
                ensure_homes(folders, self.scale.scenes.seed, self._workers)
            views = self.scale.scenes.views
            broken = generate(
                folders,
                out,
                views,
                self.scale.camera,
                self.scale.texture,
                seed,
                self._workers,
                self.scale.scenes.heights_m,
            )
            if broken:
                raise InputError("; ".join(broken.values()))
        return ViewSet([Shard(shard_path(f, out), self.scale.camera, self.scale.texture) for f in folders])

    def visibility(self, split: Split) -> list[np.ndarray]:
        """`data.visibility` of the views of a split that are evaluated, see `Scale.test_views`.

        (V, M, M) uint8 per scene; missing arrays are made now.
        """
        shards, views = self.views(split).shards, self.scale.test_views or self.scale.scenes.views
        folder = self.views_folder / f"{split}-visibility-{views}"
        paths = {shard.path.stem: folder / f"{shard.path.stem}.npy" for shard in shards}
        jobs = [
            joblib.delayed(_save_visibility)(scene, shard, views, self.scale.camera, paths[shard.path.stem])
            for scene, shard in zip(self.split.of(split), shards)
            if not paths[shard.path.stem].exists()
        ]
        for _ in run_jobs(jobs, self._workers, "visibility", len(jobs)):
            pass
        return [np.load(path) for path in paths.values()]

    @cached_property
    def augmentation(self) -> Augmentation | None:
        """The random changes of training samples; None if the scale has none."""
        if self.scale.augment == AugmentConfig():
            return None
        return Augmentation(self.scale.augment, self.scale.camera, self.bank())

    def bank(self, texture: TextureConfig | None = None) -> TextureBank:
        """A texture bank, by default of this scale's textures, from DTD's images or procedural images."""
        texture = texture or self.scale.texture
        path = self.cache / f"textures-{fingerprint(self.texture_config(texture))}.npz"
        if not path.exists():
            sources = SourceImages(self._textures)
            TextureBank.build(texture, sources, np.random.default_rng(self.scale.scenes.seed)).save(path)
        return TextureBank.load(path)


def _save_visibility(scene_folder: Path, shard: Shard, views: int, camera: CameraConfig, path: Path) -> None:
    found = shard_visibility(scene_folder, shard, views, camera)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.save(file, found)
