"""A mask is painted on an image; its map changes with each stroke.

The image is computed once (`Projector.view`), and only the mask is projected again. The browser's part is `widget.js`:
anywidget loads this file as it is, without a build, and a change transfers one bit per pixel and the cells of the map.
A matplotlib canvas (ipympl) would draw and transfer a whole figure per change.
"""

import io
from pathlib import Path
from typing import Any

import anywidget
import numpy as np
import traitlets
from matplotlib.figure import Figure
from PIL import Image

from zerobev.common.errors import InputError
from zerobev.inference import BevMap, Camera, ImageView, Masks, Projector, load, read_labels
from zerobev.inference.arrays import as_array, checked_image
from zerobev.inference.bev_map import colors_of
from zerobev.inference.modality import Names, chosen_names
from zerobev.inference.projector import LEVEL
from zerobev.inference.reader import is_source
from zerobev.interactive.example import example

#: Longer side of the painted image; larger images are painted in blocks of pixels.
MAX_SIDE_PX = 640
_NOTHING = -1  # number of pixels without an object


class Playground(anywidget.AnyWidget):
    """The widget; made by `playground`. Show it as the last line of a cell."""

    _esm = Path(__file__).with_name("widget.js")

    photograph = traitlets.Bytes().tag(sync=True)  #: PNG file, h x w
    size = traitlets.Tuple().tag(sync=True)  #: w, h
    has_instances = traitlets.Bool().tag(sync=True)
    color = traitlets.Tuple().tag(sync=True)  #: red, green and blue of the mask, 0 to 255
    bits = traitlets.CBytes().tag(sync=True)  #: the mask, h x w, packed row by row, first pixel in the highest bit
    map = traitlets.Bytes().tag(sync=True)  #: M x M x 4 RGBA
    extent = traitlets.Tuple().tag(sync=True)  #: as of `BevMap`, metres
    text = traitlets.Unicode().tag(sync=True)  #: area and place of the mask on the map

    def __init__(self, view: ImageView, rgb: np.ndarray, instances: np.ndarray, names: dict[int, str]) -> None:
        """A playground with an empty mask.

        rgb: (H, W, 3) floating point in [0, 1], the photograph of `view`
        instances: (H, W) integers, number of the object at each pixel, negative for none
        names: by number, of all objects
        """
        height, width = view.shape
        self._block_px = -(-max(height, width) // MAX_SIDE_PX)
        self._view, self._names = view, names
        self._instances = instances[:: self._block_px, :: self._block_px]
        height, width = self._instances.shape
        shown = Image.fromarray(np.round(rgb * 255).astype(np.uint8)).resize((width, height), Image.Resampling.BOX)
        file = io.BytesIO()
        shown.save(file, "png")
        self._shown = np.asarray(shown)
        self.bev: BevMap  #: of the mask, one map
        super().__init__(
            photograph=file.getvalue(),
            size=(width, height),
            has_instances=bool(names),
            bits=bytes(-(-height * width // 8)),
            extent=view.projector.camera.extent,
        )
        self._project()
        self.observe(self._project, "bits")
        self.on_msg(self._clicked)

    @traitlets.validate("bits")
    def _of_this_image(self, proposal: Any) -> bytes:
        expected = -(-self._instances.size // 8)
        if len(proposal.value) != expected:
            raise InputError(f"bits: expected {expected} bytes, found {len(proposal.value)}")
        return proposal.value

    @property
    def mask(self) -> np.ndarray:
        """(H, W) bool: the painted mask, of the photograph's size. Can be set; raises `InputError` for another size."""
        height, width = self._view.shape
        return self._painted().repeat(self._block_px, axis=0).repeat(self._block_px, axis=1)[:height, :width]

    @mask.setter
    def mask(self, mask: Any) -> None:
        image = as_array(mask, "mask")
        if image.dtype != np.bool_ or image.shape != self._view.shape:
            raise InputError(f"mask: expected bool {self._view.shape}, found {image.dtype} {image.shape}")
        self._set(image[:: self._block_px, :: self._block_px])

    def select(self, row: int, column: int) -> None:
        """Take the object at a pixel of the photograph as the mask; the mask is empty if there is none."""
        number = self._instances[row // self._block_px, column // self._block_px]
        self._set((self._instances == number) & (number >= 0))

    def picture(self) -> Figure:
        """The mask on the image, and its map: for places without a browser, such as a printed notebook."""
        figure = Figure(figsize=(8, 3.4), layout="tight")
        left, right = figure.subplots(1, 2)
        white = self._painted()[..., None]
        color = np.array(self.color)
        left.imshow(np.where(white, 0.4 * self._shown + 0.6 * color, self._shown).astype(np.uint8))
        left.set_axis_off()
        self.bev.show(right).set_title(self.text, fontsize=9)
        return figure

    def _painted(self) -> np.ndarray:
        """(h, w) bool: the mask in blocks."""
        bits = np.unpackbits(np.frombuffer(self.bits, np.uint8), count=self._instances.size)
        return bits.astype(bool).reshape(self._instances.shape)

    def _set(self, painted: np.ndarray) -> None:
        self.bits = np.packbits(painted).tobytes()

    def _clicked(self, _widget: Any, pixel: dict[str, int], _buffers: Any) -> None:
        self.select(pixel["row"] * self._block_px, pixel["column"] * self._block_px)

    def _project(self, _change: Any = None) -> None:
        name = self._name()
        self.bev = self._view.project(Masks(self.mask, [name], channels="first"))
        rgba = np.dstack([self.bev.image(), np.ones(self.bev.fov.shape)])
        area_m2 = self.bev.maps.sum() * self.bev.cell_m**2
        right_m, forward_m = self.bev.centres_m[0]
        with self.hold_sync():  # one message
            self.color = tuple(round(255 * value) for value in colors_of([name])[0])
            self.map = np.round(rgba * 255).astype(np.uint8).tobytes()
            self.text = "nothing on the map"
            if np.isfinite(forward_m):
                self.text = f"{name}: {area_m2:.2f} m², {right_m:+.2f} m right, {forward_m:.2f} m forward"

    def _name(self) -> str:
        """The object's name if the mask is that of one object."""
        painted = self._painted()
        first = self._instances.flat[painted.argmax()]
        return self._names.get(int(first), "mask") if np.array_equal(self._instances == first, painted) else "mask"


def playground(
    image: Any = None,
    model: Projector | None = None,
    camera: Camera = LEVEL,
    instances: Any = None,
    names: Names = None,
) -> Playground:
    """A widget for JupyterLab: paint a mask on an image, or click an object, and see its map change.

    image: as `rgb` of `Projector.project`; None: an example with instances
    model: default: `zerobev.load()`
    camera: of the image
    instances: (H, W) integers, one number per object from 0 up, negative for none; or an image file, see `read_labels`
    names: by number; default: the numbers
    Raises `InputError` for instances of another type or size, for instances without an image, for missing names, and as
    `Projector.view`.
    """
    if image is None:
        if instances is not None or names is not None:
            raise InputError("image: expected one with instances or names, found none")
        image, instances, names = example()
    rgb = checked_image(image)
    shape = rgb.shape[:2]
    if instances is None:
        if names is not None:
            raise InputError("names: expected names of instances, found no instances")
        numbers = np.full(shape, _NOTHING)
    else:
        numbers = read_labels(instances) if is_source(instances) else as_array(instances, "instances")
    if numbers.dtype.kind not in "iu" or numbers.shape != shape:
        raise InputError(f"instances: expected integers {shape}, found {numbers.dtype} {numbers.shape}")
    present = [number for number in np.unique(numbers).tolist() if number >= 0]
    view = (model or load()).view(rgb, camera)
    return Playground(view, rgb, numbers, dict(zip(present, chosen_names(present, names))))
