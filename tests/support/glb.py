"""GLB files put together by hand, so that a test can choose every number of them."""

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

_KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}


def encoded(image: Image.Image | np.ndarray, kind: str = "PNG", **options: int) -> bytes:
    """The file of an image."""
    stream = io.BytesIO()
    (Image.fromarray(image) if isinstance(image, np.ndarray) else image).save(stream, kind, **options)
    return stream.getvalue()


class GlbFile:
    """A header and its binary chunk; methods add to both and return indices."""

    def __init__(self) -> None:
        self.header: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}
        self.binary = bytearray()

    def add(self, kind: str, **entry: Any) -> int:
        """Add an entry to a list of the header."""
        self.header.setdefault(kind, []).append(entry)
        return len(self.header[kind]) - 1

    def view(self, content: bytes, **more: int) -> int:
        """Add a buffer view."""
        self.binary += bytes(-len(self.binary) % 4)
        start = len(self.binary)
        self.binary += content
        return self.add("bufferViews", buffer=0, byteOffset=start, byteLength=len(content), **more)

    def array(self, values: Any, kind: str = "f4", **more: Any) -> int:
        """Add an accessor."""
        stored = np.ascontiguousarray(values, "<" + kind)
        form = "SCALAR" if stored.ndim == 1 else f"VEC{stored.shape[1]}"
        view = self.view(stored.tobytes())
        return self.add("accessors", bufferView=view, componentType=_KINDS[kind], count=len(stored), type=form, **more)

    def material(self, image: bytes | None = None, sampler: dict | None = None, **more: Any) -> int:
        """Add an unlit, double-sided material; `info` goes to its texture, `factor` is the base colour."""
        surface: dict[str, Any] = {"metallicFactor": 0.0}
        if "factor" in more:
            surface["baseColorFactor"] = more.pop("factor")
        info = more.pop("info", {})
        if image is not None:
            kind = "image/png" if image.startswith(b"\x89PNG") else "image/jpeg"
            texture = {"source": self.add("images", bufferView=self.view(image), mimeType=kind)}
            if sampler is not None:
                texture["sampler"] = self.add("samplers", **sampler)
            surface["baseColorTexture"] = {"index": self.add("textures", **texture), **info}
        unlit = {"KHR_materials_unlit": {}}
        return self.add("materials", pbrMetallicRoughness=surface, **{"doubleSided": True, "extensions": unlit} | more)

    def place(self, primitive: dict[str, Any], **node: Any) -> int:
        """Add a mesh of one primitive, and a node in the scene that shows it."""
        index = self.add("nodes", mesh=self.add("meshes", primitives=[primitive]), **node)
        self.header["scenes"][0]["nodes"].append(index)
        return index

    def quad(self, corners: Any, uv: Any, material: int, **attributes: int) -> dict[str, Any]:
        """A primitive of two triangles; `uv` may be an accessor already."""
        uv = uv if isinstance(uv, int) else self.array(uv)
        indices = self.array([0, 1, 2, 0, 2, 3], "u2")
        named = {"POSITION": self.array(corners), "TEXCOORD_0": uv, **attributes}
        return {"attributes": named, "indices": indices, "material": material}

    def save(self, path: Path) -> Path:
        """Write the file."""
        header = {**self.header, "buffers": [{"byteLength": len(self.binary)}, *self.header.get("buffers", [])]}
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.binary) + bytes(-len(self.binary) % 4)
        parts = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts)
        return path
