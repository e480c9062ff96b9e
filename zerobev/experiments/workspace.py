"""The data of one scale on this machine: scenes, views and textures, made when they are first asked for.

Everything here can be made again, and lives in the ignored folder `.cache`; results live in `reports`.
"""

import hashlib
import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from zerobev import config
from zerobev.common.errors import InputError
from zerobev.config import TextureConfig
from zerobev.data.generate import generate, shard_path
from zerobev.data.patterns import SourceImages
from zerobev.data.samples import ViewSet
from zerobev.data.shards import Shard, recorded_with
from zerobev.data.textures import TextureBank
from zerobev.scenes.hm3dsem import Split, read_scene, split_scenes
from zerobev.scenes.homes import ensure_home, ensure_homes, home_folders
from zerobev.scenes.scene import Scene

#: Raised by hand whenever homes, sensors or textures change what they make: stale data is then left aside.
DATA_VERSION = 2

ROOT = Path(__file__).resolve().parents[2]


class Workspace:
    """Scenes, views and textures of a scale, from generated homes or from an HM3DSem folder."""

    def __init__(self, scale: str, scenes: str = "", root: Path = ROOT) -> None:
        """`scale` is a name in `config.SCALES`; `scenes` a folder in HM3DSem layout, or "" for generated homes."""
        self.scale = config.scale(scale)
        self.source = Path(scenes).expanduser().resolve() if scenes else None
        if self.source and not self.source.is_dir():
            raise InputError(f"scenes: expected a folder in HM3DSem layout, found nothing at {scenes}")
        self.reports = root / "reports" / (f"{scale}-{self.source.name}-scenes" if self.source else scale)
        textures = os.environ.get("ZEROBEV_TEXTURES")  # set by `make reproduce TEXTURES=...`
        self._textures = Path(textures) if textures else None
        self.cache = root / ".cache"
        self._workers = os.cpu_count() or 1

    @property
    def identity(self) -> dict[str, Any]:
        """What the views depend on, as plain data: it is part of a record's key."""
        identity = {
            "version": DATA_VERSION,
            **recorded_with(self.scale.camera, self.scale.texture),
            "scenes": asdict(self.scale.scenes),
        }
        if self.source:
            files = sorted(f for f in self.source.rglob("*.semantic.*") if f.is_file())
            identity["source"] = {f.name: f.stat().st_size for f in files}
        return identity

    def texture_identity(self, texture: TextureConfig) -> dict[str, Any]:
        """What a texture bank depends on, as plain data."""
        source = self._textures.name if self._textures else "procedural"
        return {"version": DATA_VERSION, "sources": source, **asdict(texture)}

    @property
    def runs(self) -> Path:
        """Folder of checkpoints and logs."""
        return self.cache / "runs" / self.reports.name

    @property
    def split(self) -> Split:
        """Folders of the training, validation and test scenes; generated ones may not be written yet."""
        if self.source:
            return split_scenes(self.source)
        return home_folders(self.cache / f"homes-{DATA_VERSION}-{self.scale.scenes.seed}", self.scale.scenes)

    def scene(self, part: str, index: int) -> Scene:
        """Scene number `index` of the split `part` ("train", "validation" or "test")."""
        folder = getattr(self.split, part)[index]
        if not self.source:
            ensure_home(folder, self.scale.scenes.seed)
        return read_scene(folder)

    def views(self, part: str, scenes: int | None = None) -> ViewSet:
        """The recorded views of the first `scenes` scenes of a split (default: all), recorded now if missing.

        Raises `InputError` that names the scenes which could not be recorded.
        """
        folders = list(getattr(self.split, part)[:scenes])
        seed = self.scale.scenes.seed + ("train", "validation", "test").index(part)
        out = self.cache / f"views-{fingerprint(self.identity)}" / part
        if not all(shard_path(folder, out).exists() for folder in folders):
            if not self.source:
                ensure_homes(folders, self.scale.scenes.seed, self._workers)
            views = self.scale.scenes.views
            broken = generate(folders, out, views, self.scale.camera, self.scale.texture, seed, self._workers)
            if broken:
                raise InputError("; ".join(broken.values()))
        return ViewSet([Shard(shard_path(f, out), self.scale.camera, self.scale.texture) for f in folders])

    def bank(self, texture: TextureConfig | None = None) -> TextureBank:
        """A texture bank, by default of this scale's textures; from DTD's images or procedural ones."""
        texture = texture or self.scale.texture
        path = self.cache / f"textures-{fingerprint(self.texture_identity(texture))}.npz"
        if not path.exists():
            sources = SourceImages(self._textures)
            TextureBank.build(texture, sources, np.random.default_rng(self.scale.scenes.seed)).save(path)
        return TextureBank.load(path)


def fingerprint(value: Any) -> str:
    """Twelve hexadecimal digits of the SHA-256 of plain data: equal data, equal name."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:12]
