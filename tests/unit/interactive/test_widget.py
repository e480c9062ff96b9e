"""The playground: the kernel's part alone, and the browser's part in headless Chromium with the kernel's state."""

import base64
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from skimage.transform import resize

import zerobev
from zerobev.common.errors import InputError
from zerobev.interactive import Playground
from zerobev.interactive.example import example
from zerobev.interactive.widget import MAX_SIDE_PX

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SHAPE = (60, 80)
CAMERA = zerobev.Camera(hfov_deg=90, height_m=1.2)


@pytest.fixture(scope="module")
def model() -> zerobev.Projector:
    torch.set_num_threads(1)
    return zerobev.load()


@pytest.fixture(scope="module")
def rgb() -> np.ndarray:
    """The package's photograph, small."""
    return np.round(255 * resize(example()[0][32:224], SHAPE)).astype(np.uint8)


@pytest.fixture(scope="module")
def instances() -> np.ndarray:
    numbers = np.full(SHAPE, -1)
    numbers[30:, :50], numbers[40:50, 10:30], numbers[20:35, 60:75] = 0, 4, 7
    return numbers


NAMES = {0: "floor", 4: "rug", 7: "sofa"}


def painted(rectangle: tuple[slice, slice], shape: tuple[int, int] = SHAPE) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[rectangle] = True
    return mask


def receive(widget: Playground, mask: np.ndarray) -> None:
    """A message of the browser with a changed mask; ipywidgets hands buffers over as memoryview."""
    widget.set_state({"bits": memoryview(np.packbits(mask).tobytes())})


def assert_shows(widget: Playground, expected: zerobev.BevMap) -> None:
    np.testing.assert_array_equal(widget.bev.values, expected.values)
    rgba = np.frombuffer(widget.map, np.uint8).reshape(*expected.fov.shape, 4)
    np.testing.assert_allclose(rgba[..., :3] / 255, expected.image(), atol=0.5 / 255 + 1e-9)
    assert (rgba[..., 3] == 255).all()


def test_a_painted_mask_gives_the_map_of_the_view(model, rgb):
    widget, view, seen = zerobev.playground(rgb, model, CAMERA), model.view(rgb, CAMERA), []
    assert not widget.mask.any() and widget.text == "nothing on the map"
    model.network.backbone.register_forward_hook(lambda *_: seen.append(1))
    for rectangle in ((slice(30, 50), slice(10, 50)), (slice(20, 60), slice(37, 80)), (slice(0), slice(0))):
        mask = painted(rectangle)
        receive(widget, mask)
        np.testing.assert_array_equal(widget.mask, mask)
        assert_shows(widget, view.project(mask))
        other = painted((slice(10, 58), slice(3, 70)))
        widget.mask = other
        np.testing.assert_array_equal(widget.mask, other)
        assert_shows(widget, view.project(other))
    assert not seen  # the photograph is computed once


def test_the_text_is_area_and_place(model, rgb):
    widget = zerobev.playground(rgb, model)
    receive(widget, painted((slice(35, 55), slice(10, 50))))
    (row,) = widget.bev.footprints().to_dict("records")
    place = f"{row['right_m']:+.2f} m right, {row['forward_m']:.2f} m forward"
    assert widget.text == f"mask: {row['area_m2']:.2f} m², {place}"


def test_a_click_selects_an_object(model, rgb, instances):
    widget, view = zerobev.playground(rgb, model, instances=instances, names=NAMES), model.view(rgb)
    assert widget.has_instances and not zerobev.playground(rgb, model).has_instances
    for (row, column), number in {(55, 5): 0, (45, 20): 4, (21, 74): 7}.items():
        widget._handle_custom_msg({"row": row, "column": column}, [])
        np.testing.assert_array_equal(widget.mask, instances == number)
        assert_shows(widget, view.project(instances == number, names=[NAMES[number]]))
        assert widget.text.startswith(f"{NAMES[number]}: ") and widget.bev.labels == (NAMES[number],)
    receive(widget, widget.mask | painted((slice(0, 5), slice(0, 5))))
    assert widget.bev.labels == ("mask",)
    widget.select(5, 70)
    assert not widget.mask.any() and widget.bev.labels == ("mask",)


def test_a_large_image_is_painted_in_blocks(model):
    shape = (3 * MAX_SIDE_PX - 100, 2 * MAX_SIDE_PX + 1)
    rgb = np.zeros((*shape, 3), np.uint8)
    numbers = painted((slice(1200, 1500), slice(300, 600)), shape).astype(int) - 1
    widget = zerobev.playground(rgb, model, instances=numbers)
    width, height = widget.size
    assert (width, height) == (-(-shape[1] // 3), -(-shape[0] // 3))
    widget._handle_custom_msg({"row": 499, "column": 199}, [])
    np.testing.assert_array_equal(widget.mask, numbers == 0)
    assert_shows(widget, model.view(rgb).project(numbers == 0))


def test_the_example_is_shown_without_an_image(model):
    rgb, numbers, names = example()
    widget = zerobev.playground(model=model)
    row, column = np.argwhere(numbers == names.index("carpet"))[0].tolist()
    widget.select(row, column)
    assert_shows(widget, model.view(rgb).project(numbers == names.index("carpet")))
    assert widget.text.startswith("carpet: ")
    left, right = widget.picture().axes
    assert left.images[0].get_array().shape == rgb.shape
    changed = (np.asarray(left.images[0].get_array()) != widget._shown).any(axis=-1)
    assert (changed == widget.mask).mean() > 0.999  # a few pixels of the image have the mask's colour
    np.testing.assert_array_equal(right.images[0].get_array(), widget.bev.image())


def test_bad_input_is_one_line(model, rgb, instances):
    for arguments, message in (
        ({"image": rgb[..., 0]}, r"rgb: expected \(H, W, 3\), found \(60, 80\)"),
        (
            {"image": rgb, "instances": instances[1:]},
            r"instances: expected integers \(60, 80\), found int64 \(59, 80\)",
        ),
        (
            {"image": rgb, "instances": instances / 2},
            r"instances: expected integers \(60, 80\), found float64 \(60, 80",
        ),
        ({"image": rgb, "instances": instances, "names": {0: "floor"}}, "names: expected one for every mask or label"),
        ({"image": rgb, "names": ["floor"]}, "names: expected names of instances, found no instances"),
        ({"instances": instances}, "image: expected one with instances or names, found none"),
        ({"image": rgb, "camera": 90}, "camera: expected a zerobev.Camera, found 90"),
    ):
        with pytest.raises(InputError, match=message):
            zerobev.playground(model=model, **arguments)
    widget = zerobev.playground(rgb, model)
    for mask, found in (
        (painted((slice(9), slice(9)), (80, 60)), "bool (80, 60)"),
        (np.zeros(SHAPE), "float64 (60, 80)"),
    ):
        with pytest.raises(InputError) as error:
            widget.mask = mask
        assert str(error.value) == f"mask: expected bool (60, 80), found {found}"
    with pytest.raises(InputError, match="bits: expected 600 bytes, found 3"):
        widget.bits = b"abc"


#: A page with the state of a widget in place of Jupyter's model: it paints, and prints messages and colours.
PAGE = """<!doctype html><body><div id="widget"></div><pre id="found"></pre><script type="module">
const binary = (text) => new DataView(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
const text = (view) => btoa(String.fromCharCode(...new Uint8Array(view.buffer)));
const { module, state, answer } = JSON.parse(atob("INPUT"));
for (const one of [state, answer])
  for (const name of ["photograph", "bits", "map"]) if (name in one) one[name] = binary(one[name]);

const listeners = {}, sent = [], clicks = [];
const model = {
  get: (name) => state[name],
  set: (name, value) => { state[name] = value; (listeners[`change:${name}`] ?? []).forEach((one) => one()); },
  on: (event, one) => (listeners[event] ??= []).push(one),
  off: (event, one) => (listeners[event] = listeners[event].filter((other) => other !== one)),
  save_changes: () => sent.push(text(state.bits)),
  send: (message) => clicks.push(message),
};
const el = document.getElementById("widget");
const { default: widget } = await import(URL.createObjectURL(new Blob([module], { type: "text/javascript" })));
const remove = widget.render({ model, el });
const [image, plan] = el.querySelectorAll("canvas");
const press = (name) => [...el.querySelectorAll("button")].find((one) => one.textContent === name).click();
const at = (type, column, row) => {
  const box = image.getBoundingClientRect();
  const clientX = box.left + (column / image.width) * box.width, clientY = box.top + (row / image.height) * box.height;
  const init = { clientX, clientY, buttons: type === "pointerup" ? 0 : 1, bubbles: true, cancelable: true };
  image.dispatchEvent(new PointerEvent(type, init));
};
const color = (canvas, x, y) => [...canvas.getContext("2d").getImageData(x, y, 1, 1).data];
const found = { hidden: el.querySelector("button").hidden };
at("pointerdown", 20.5, 45.5);
at("pointermove", 60.5, 45.5);
found.clicks = clicks.slice();
found.unsent = sent.length;
press("brush");
el.querySelector("input").value = 10;  // a radius of 4 pixels
at("pointerdown", 20, 30);
at("pointermove", 60, 30);
at("pointerup", 60, 30);
found.stroke = sent.at(-1);
found.overlay = [color(image, 40, 30), color(image, 40, 40)];
press("erase");
at("pointerdown", 40, 30);
found.erased = sent.at(-1);
press("clear");
found.cleared = sent.at(-1);
for (const name of ["map", "text", "bits", "color"]) model.set(name, answer[name]);
found.answered = [color(image, 40, 20), color(image, 40, 40)];
found.text = el.querySelector("output").textContent;
found.plan = answer.places.map(([x, y]) => color(plan, x, y));
remove();
found.left = Object.values(listeners).flat().length;
document.getElementById("found").textContent = JSON.stringify(found);
</script></body>"""


def in_browser(page: str, folder: Path) -> dict:
    """The object that a page prints, as headless Chromium shows it."""
    (folder / "page.html").write_text(page)
    options = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"
    options += " --disable-component-update --disable-sync --virtual-time-budget=20000 --dump-dom"
    command = [CHROMIUM, *options.split(), f"--user-data-dir={folder / 'profile'}", (folder / "page.html").as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=300)
    _, _, rest = shown.stdout.partition('<pre id="found">')
    found, _, _ = rest.partition("</pre>")
    assert found, shown.stdout[-2000:] + shown.stderr[-4000:]
    return json.loads(found)


def as_text(state: dict) -> dict:
    """Bytes as base64, for JSON."""
    return {
        name: base64.b64encode(value).decode() if isinstance(value, bytes) else value for name, value in state.items()
    }


def disc(column: float, row: float, radius: float) -> np.ndarray:
    rows, columns = np.indices(SHAPE) + 0.5
    return np.hypot(columns - column, rows - row) <= radius


def mask_of(bits: str) -> np.ndarray:
    flat = np.unpackbits(np.frombuffer(base64.b64decode(bits), np.uint8), count=SHAPE[0] * SHAPE[1])
    return flat.reshape(SHAPE).astype(bool)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
def test_the_browser_paints_selects_and_shows_the_map(model, rgb, instances, tmp_path):
    widget = zerobev.playground(rgb, model, instances=instances, names=NAMES)
    names = ("photograph", "size", "has_instances", "color", "bits", "map", "extent", "text")
    state = as_text({name: getattr(widget, name) for name in names})
    color = widget.color
    widget.select(59, 0)
    answer = as_text({name: getattr(widget, name) for name in ("bits", "color", "map", "text")})
    # the map is 296 pixels wide on the screen, from (36, 8) on
    side = len(widget.bev.fov)
    cells = [
        (int(36 + (column + 0.5) * 296 / side), int(8 + (row + 0.5) * 296 / side))
        for row, column in np.ndindex(side, side)
    ]
    answer["places"] = cells
    module = (Path(zerobev.__file__).parent / "interactive/widget.js").read_text()
    given = base64.b64encode(json.dumps({"module": module, "state": state, "answer": answer}).encode()).decode()
    found = in_browser(PAGE.replace("INPUT", given), tmp_path)

    assert found["hidden"] is False and found["unsent"] == 0
    assert found["clicks"] == [{"row": 45, "column": 20}]
    stroke = mask_of(found["stroke"])
    assert stroke[disc(20, 30, 3.5) | disc(60, 30, 3.5) | painted((slice(27, 33), slice(20, 60)))].all()
    assert not stroke[~(disc(20, 30, 4) | disc(60, 30, 4) | painted((slice(26, 34), slice(20, 60))))].any()
    np.testing.assert_array_equal(mask_of(found["erased"]), stroke & ~disc(40, 30, 4))
    assert not mask_of(found["cleared"]).any()
    assert widget.color != color  # of a class, instead of a mask without a name
    for (inside, outside), shown in ((found["overlay"], color), (found["answered"][::-1], widget.color)):
        assert outside[3] == 0 and np.abs(np.array(inside[:3]) - shown).max() <= 1 and 0 < inside[3] < 255
    assert found["text"] == widget.text
    np.testing.assert_array_equal(np.ravel(found["plan"]), np.frombuffer(widget.map, np.uint8))
    assert len(np.unique(found["plan"], axis=0)) > 3
    assert found["left"] == 0
