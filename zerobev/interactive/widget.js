// The browser's part of the playground. The model has the state (see widget.py), and this file draws it. Strokes change
// `bits`; Jupyter sends the latest value as soon as the kernel has answered the last one.

const LONGER_SIDE_PX = 400; // of the image on the screen
const MAP_PX = 340;
const MARGIN_PX = 36; // of the map, for its axes
const OPACITY = 150; // of the mask, out of 255

const STYLE = `
.zerobev { display: inline-grid; grid-template-columns: auto auto; gap: 8px 16px; font: 13px sans-serif; }
.zerobev-image { position: relative; }
.zerobev-image > * { position: absolute; inset: 0; width: 100%; height: 100%; }
.zerobev-image > canvas { cursor: crosshair; image-rendering: pixelated; touch-action: none; }
.zerobev-tools { display: flex; gap: 6px; align-items: center; }
.zerobev-tools > [aria-pressed="true"] { outline: 2px solid currentColor; }
`;

function element(parent, tag, properties = {}) {
  return parent.appendChild(Object.assign(document.createElement(tag), properties));
}

function bytes(view) {
  return new Uint8Array(view.buffer, view.byteOffset, view.byteLength);
}

function unpacked(bits, count) {
  return Uint8Array.from({ length: count }, (_, i) => (bits[i >> 3] >> (7 - (i & 7))) & 1);
}

function packed(mask) {
  const bits = new Uint8Array(Math.ceil(mask.length / 8));
  mask.forEach((white, i) => (bits[i >> 3] |= white << (7 - (i & 7))));
  return bits;
}

function render({ model, el }) {
  const [width, height] = model.get("size");
  const scale = LONGER_SIDE_PX / Math.max(width, height);
  let mask, last;

  const root = element(el, "div", { className: "zerobev" });
  element(root, "style", { textContent: STYLE });
  const stack = element(root, "div", { className: "zerobev-image" });
  Object.assign(stack.style, { width: `${width * scale}px`, height: `${height * scale}px` });
  const url = URL.createObjectURL(new Blob([model.get("photograph")], { type: "image/png" }));
  element(stack, "img", { src: url, alt: "the image" });
  const canvas = element(stack, "canvas", { width, height, ariaLabel: "the mask" });
  const plan = element(root, "canvas", { width: MAP_PX, height: MAP_PX, ariaLabel: "the map" });
  const tools = element(root, "div", { className: "zerobev-tools" });
  const text = element(root, "output");

  const buttons = ["select", "brush", "erase"].map((name) => element(tools, "button", { textContent: name }));
  const use = (button) => buttons.forEach((one) => (one.ariaPressed = String(one === button)));
  const tool = () => buttons.find((one) => one.ariaPressed === "true").textContent;
  buttons.forEach((button) => (button.onclick = () => use(button)));
  buttons[0].hidden = !model.get("has_instances");
  use(buttons[buttons[0].hidden ? 1 : 0]);
  element(tools, "button", { textContent: "clear", onclick: () => send(new Uint8Array(mask.length)) });
  const label = element(tools, "label", { textContent: "size " });
  const percent = element(label, "input", { type: "range", min: 1, max: 20, value: 5 }); // of the width

  function send(changed) {
    model.set("bits", new DataView(packed(changed).buffer));
    model.save_changes();
  }

  function stroke(from, to) {
    const white = Number(tool() === "brush");
    const radius = (percent.valueAsNumber / 200) * width;
    const steps = Math.ceil(Math.hypot(to.x - from.x, to.y - from.y) / Math.max(1, radius / 2)) || 1;
    for (let step = 0; step <= steps; step++) {
      const x = from.x + ((to.x - from.x) * step) / steps;
      const y = from.y + ((to.y - from.y) * step) / steps;
      for (let row = Math.max(0, Math.floor(y - radius)); row < Math.min(height, y + radius); row++)
        for (let column = Math.max(0, Math.floor(x - radius)); column < Math.min(width, x + radius); column++)
          if (Math.hypot(column + 0.5 - x, row + 0.5 - y) <= Math.max(radius, 0.71)) mask[row * width + column] = white;
    }
    send(mask);
  }

  function point(event) {
    const box = canvas.getBoundingClientRect();
    return {
      x: ((event.clientX - box.left) / box.width) * width,
      y: ((event.clientY - box.top) / box.height) * height,
    };
  }

  canvas.onpointerdown = (event) => {
    event.preventDefault();
    const { x, y } = point(event);
    if (tool() === "select") model.send({ row: Math.floor(y), column: Math.floor(x) });
    else stroke((last = { x, y }), last);
  };
  canvas.onpointermove = (event) => {
    const here = point(event);
    if (tool() !== "select" && event.buttons & 1) stroke(last ?? here, here);
    last = here;
  };
  canvas.onpointerleave = () => (last = undefined);

  function drawMask() {
    mask = unpacked(bytes(model.get("bits")), width * height);
    const pixels = new ImageData(width, height);
    const color = [...model.get("color"), OPACITY];
    mask.forEach((white, i) => white && pixels.data.set(color, 4 * i));
    canvas.getContext("2d").putImageData(pixels, 0, 0);
  }

  function drawMap() {
    const rgba = new Uint8ClampedArray(bytes(model.get("map")));
    const cells = Math.sqrt(rgba.length / 4);
    const small = Object.assign(document.createElement("canvas"), { width: cells, height: cells });
    small.getContext("2d").putImageData(new ImageData(rgba, cells, cells), 0, 0);

    const pen = plan.getContext("2d");
    const side = MAP_PX - MARGIN_PX - 8;
    const [left, right, near, far] = model.get("extent");
    const across = (metres) => MARGIN_PX + ((metres - left) / (right - left)) * side;
    const up = (metres) => 8 + ((far - metres) / (far - near)) * side;
    pen.fillStyle = "white";
    pen.fillRect(0, 0, MAP_PX, MAP_PX);
    pen.imageSmoothingEnabled = false;
    pen.drawImage(small, MARGIN_PX, 8, side, side);
    pen.strokeStyle = "#999";
    pen.strokeRect(MARGIN_PX, 8, side, side);
    pen.fillStyle = "black";
    pen.textAlign = "center";
    for (let metre = Math.ceil(left); metre <= right; metre++) pen.fillText(metre, across(metre), MAP_PX - 18);
    pen.fillText("right [m]", across((left + right) / 2), MAP_PX - 5);
    for (let metre = Math.ceil(near); metre <= far; metre++) pen.fillText(metre, MARGIN_PX - 8, up(metre) + 4);
    pen.save();
    pen.translate(12, up((near + far) / 2));
    pen.rotate(-Math.PI / 2);
    pen.fillText("forward [m]", 0, 0);
    pen.restore();
  }

  function drawText() {
    text.textContent = model.get("text");
  }

  const drawn = { "change:bits": drawMask, "change:color": drawMask, "change:map": drawMap, "change:text": drawText };
  for (const [event, draw] of Object.entries(drawn)) {
    draw();
    model.on(event, draw);
  }
  return () => {
    for (const [event, draw] of Object.entries(drawn)) model.off(event, draw);
    URL.revokeObjectURL(url);
  };
}

export default { render };
