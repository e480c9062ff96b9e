"""Cost of a training step and its bounds; part of `zerobev benchmark`.

Two bounds are measured at the same time on the same machine: the rate of a large matrix product, and a *roofline*
(Williams et al. 2009). On the roofline, an operation takes the longer of two times: its products at that rate, or its
bytes at the rate of a large copy.
"""

import itertools
import tempfile
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode, flop_registry

from zerobev.benchmarks.data import home_folder, spread, stored_views, synth_stream
from zerobev.config import SCALES, CameraConfig, Scale, scale
from zerobev.models import BevModel, ZeroBEV, build
from zerobev.training.loader import Source, moved
from zerobev.training.losses import zero_bev_loss
from zerobev.training.precision import computes_bfloat16

_MATMUL = 2048  # side of the matrices in the product that gives the peak
_COPIED = 2**24  # float32 numbers in the copy that gives the bandwidth
_PAPER_SAMPLES = 2  # of a step at the paper's sizes; 16 exceed the memory of a laptop
#: Operations that reserve memory without access.
_RESERVING = ("empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided")

Run = Callable[[], Any]
Name = TypeVar("Name", bound=Hashable)


class Machine:
    """The device of all measurements, and its clock."""

    def __init__(self) -> None:
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.bfloat16 = computes_bfloat16(self.device.type)

    def autocast(self, enabled: bool = True) -> torch.autocast:
        """Autocast to bfloat16, as in training; never where the device does not compute in it."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=enabled and self.bfloat16)

    def milliseconds(self, runs: Mapping[Name, Run], repeats: int) -> dict[Name, dict[str, float]]:
        """Spread of the time per run; interleaved, so that machine noise hits all alike."""
        times: dict[Name, list[float]] = {name: [] for name in runs}
        for repeat in range(repeats + 1):  # the first is a warm-up
            for name, run in runs.items():
                start = time.perf_counter()
                run()
                self.finish()
                if repeat:
                    times[name].append(1e3 * (time.perf_counter() - start))
        return {name: spread(values) for name, values in times.items()}

    def finish(self) -> None:
        """Wait for the end of all work on a GPU."""
        if self.device.type == "cuda":
            torch.cuda.synchronize()

    def batch(self, camera: CameraConfig, samples: int, images: int = 1) -> dict[str, Tensor]:
        """Random tensors with the shapes of `data.samples`; their content does not affect the time."""
        side, cells = camera.fpv_px, camera.bev_px
        shapes = {"rgb": (3, side), "zero": (images, side), "depth": (1, side), "target": (images, cells)}
        shapes |= {"aux": (2, cells), "fov": (1, cells)}
        random = {name: torch.rand(samples, k, n, n, device=self.device) for name, (k, n) in shapes.items()}
        return {name: image if name in ("rgb", "depth") else image.round() for name, image in random.items()}


def training_step(net: BevModel, batch: dict[str, Tensor], machine: Machine) -> Run:
    """One step as in `training.train`: forward, loss, backward, Adam."""
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-4, fused=True)
    net.train()

    def step() -> None:
        with machine.autocast():
            projection = net(batch["rgb"], batch["zero"], batch["depth"])
        zero_bev_loss(projection, batch, 0.5, net.config.aux).total.backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def blocks(net: ZeroBEV, batch: dict[str, Tensor], machine: Machine) -> dict[str, Run]:
    """Forward and backward pass of each block of the network alone, on its inputs in a step."""
    with machine.autocast():
        laterals = net.rgb_laterals(batch["rgb"])
        fpv = net.fpv_maps(laterals, batch["zero"])
        bev, _ = net.bands(fpv)
    inputs = {name: _leaves(maps) for name, maps in {"laterals": laterals, "fpv": fpv, "bev": [bev]}.items()}
    parts: dict[str, Callable[[], Iterable[Tensor]]] = {
        "backbone": lambda: net.rgb_laterals(batch["rgb"]),
        "zero-shot CNN and pyramid": lambda: net.fpv_maps(inputs["laterals"], batch["zero"]),
        "band transformers": lambda: [net.bands(inputs["fpv"])[0]],
        "U-Net": lambda: [net.decoder(inputs["bev"][0])],
    }

    def both(part: Callable[[], Iterable[Tensor]]) -> Run:
        def run() -> None:
            with machine.autocast():
                outputs = list(part())
            torch.autograd.backward(outputs, [torch.ones_like(output) for output in outputs])

        return run

    return {name: both(part) for name, part in parts.items()}


def flops(run: Run) -> int:
    """Number of floating-point operations of matrix products and convolutions, forward and backward."""
    with FlopCounterMode(display=False) as counter:
        run()
    return counter.get_total_flops()


class _Operations(TorchDispatchMode):
    """Collects floating-point operations and bytes of each operation in its context."""

    def __init__(self) -> None:
        super().__init__()
        self.noted: list[tuple[int, int]] = []  #: floating-point operations, bytes

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        result = operation(*args, **kwargs)
        count = flop_registry.get(operation.overloadpacket)
        operations = count(*args, **kwargs, out_val=result) if count else 0
        self.noted.append((operations, _bytes_moved(operation, tree_leaves((args, kwargs)), tree_leaves(result))))
        return result


def _bytes_moved(operation: Any, inputs: list[Any], outputs: list[Any]) -> int:
    """Minimum of bytes that an operation reads and writes: each tensor once, 0 for a view."""
    read, written = ([t for t in of if isinstance(t, Tensor)] for of in (inputs, outputs))
    makes_views = not operation._schema.is_mutable and set(map(_storage, written)) <= set(map(_storage, read))
    if makes_views or operation.overloadpacket.__name__ in _RESERVING:
        return 0
    # a tensor that is changed in place counts once
    return sum({t.data_ptr(): min(t.nbytes, t.untyped_storage().nbytes()) for t in (*read, *written)}.values())


def _storage(tensor: Tensor) -> int:
    return tensor.untyped_storage()._cdata


def min_milliseconds(run: Run, peak_tflops: float, bandwidth_gbs: float) -> float:
    """Milliseconds of `run` on the roofline: the sum over operations of the longer of products and memory access.

    Bytes in a processor cache count as memory access, so small operations can be faster.
    """
    with _Operations() as operations:
        run()
    return sum(max(count / peak_tflops / 1e9, size / bandwidth_gbs / 1e6) for count, size in operations.noted)


def measure_training(setting: Scale, machine: Machine, repeats: int) -> dict[str, Any]:
    """Time of a step of (c) and of its blocks, with the fractions of peak and roofline.

    The peak is the rate of a product of 2048 x 2048 matrices, in bfloat16 if training uses it.
    """
    net = build("c", setting.camera, setting.model).to(machine.device)
    assert isinstance(net, ZeroBEV)  # as row (c) is
    batch = machine.batch(setting.camera, setting.train.batch)
    runs = {"step": training_step(net, batch, machine)} | blocks(net, batch, machine)
    return against_the_machine(runs, machine, repeats)


def measure_paper_step(machine: Machine, repeats: int) -> dict[str, Any]:
    """A step of (c) at the paper's sizes with two samples, without dropout and with the paper's dropout.

    On a CPU, torch draws dropout's random numbers one by one; this time is on neither side of the roofline.
    """
    paper = scale("paper")
    net = build("c", paper.camera, paper.model).to(machine.device)
    step = training_step(net, machine.batch(paper.camera, _PAPER_SAMPLES), machine)
    steps: dict[str, Run] = {
        "step": partial(_with_dropout, step, net, 0.0),
        "with dropout": partial(_with_dropout, step, net, paper.model.dropout),
    }
    return against_the_machine(steps, machine, repeats)


def _with_dropout(step: Run, net: BevModel, probability: float) -> None:
    for module in net.modules():
        if isinstance(module, nn.Dropout):
            module.p = probability
    step()


def against_the_machine(runs: dict[str, Run], machine: Machine, repeats: int) -> dict[str, Any]:
    """Time of `runs`, interleaved with a matrix product and a copy, and its fractions of these bounds.

    Returns `milliseconds` with their spread, `gigaflops`, the bounds, and per run: `share_of_peak`, the same on the
    roofline (`roofline_share_of_peak`), and `share_of_roofline`.
    """
    matrix = torch.rand(_MATMUL, _MATMUL, device=machine.device)
    matrix = matrix.bfloat16() if machine.bfloat16 else matrix
    source, target = torch.rand(2, _COPIED, device=machine.device)
    rates: dict[str, Run] = {"matrix product": lambda: matrix @ matrix, "copy": lambda: target.copy_(source)}
    milliseconds = machine.milliseconds(rates | runs, repeats)
    # medians: on a shared machine, single products can be three times as fast, whole steps cannot
    peak, best = (2 * _MATMUL**3 / milliseconds["matrix product"][of] / 1e9 for of in ("median", "low"))
    bandwidth = 2 * 4 * _COPIED / milliseconds["copy"]["median"] / 1e6
    operations = {name: flops(run) for name, run in runs.items()}
    roofline = {name: min_milliseconds(run, peak, bandwidth) for name, run in runs.items()}
    return {
        "milliseconds": milliseconds,
        "gigaflops": {name: count / 1e9 for name, count in operations.items()},
        "peak_tflops": peak,
        "best_tflops": best,
        "bandwidth_gbs": bandwidth,
        "share_of_peak": {n: count / milliseconds[n]["median"] / 1e9 / peak for n, count in operations.items()},
        "roofline_share_of_peak": {n: count / roofline[n] / 1e9 / peak for n, count in operations.items()},
        "share_of_roofline": {name: roofline[name] / milliseconds[name]["median"] for name in runs},
    }


def few(repeats: int) -> int:
    """Number of repeats at the paper's sizes, where one takes seconds."""
    return max(repeats // 3, 1)


def draw(stream: Source, steps: Iterator[int], machine: Machine) -> None:
    """Draw the batch of the next step, up to the device."""
    moved(stream.batch(next(steps)), machine.device)


def measure_drawing(machine: Machine, repeats: int) -> dict[str, Any]:
    """Time of drawing a batch, in the process and up to the device, and of a step of (c), at every scale.

    Views of one generated home; `share` is the fraction of drawing in the sum of both.
    """
    measured = {}
    with tempfile.TemporaryDirectory() as folder:
        home = home_folder(Path(folder), 0)
        for name, setting in SCALES.items():
            samples, turns = (_PAPER_SAMPLES, few(repeats)) if name == "paper" else (setting.train.batch, repeats)
            views = stored_views(home, Path(folder) / f"{name}.h5", setting, setting.train.batch)
            net = build("c", setting.camera, setting.model).to(machine.device)
            runs: dict[str, Run] = {
                "batch": partial(draw, synth_stream(views, setting, samples), itertools.count(), machine),
                "step": training_step(net, machine.batch(setting.camera, samples), machine),
            }
            found = machine.milliseconds(runs, turns)
            batch, step = (found[part]["median"] for part in ("batch", "step"))
            measured[name] = {"samples": samples, "milliseconds": found, "share": batch / (batch + step)}
    return measured


def _leaves(maps: Iterable[Tensor]) -> list[Tensor]:
    return [m.detach().clone().requires_grad_() for m in maps]
