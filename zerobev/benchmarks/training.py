"""What a training step costs, and what keeps it from being faster; part of `python -m zerobev.benchmarks.run`.

Milliseconds belong to a machine and a minute. Beside them stand two measures of what the same machine could do in the
same minutes: the rate of a large matrix product, and a *roofline* (Williams et al. 2009), for which each operation
takes its products at that rate or its bytes at the rate of a large copy, whichever is longer.
"""

import itertools
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode, flop_registry

from zerobev.benchmarks.data import spread
from zerobev.config import CameraConfig, Scale, scale
from zerobev.data.samples import SynthSamples
from zerobev.experiments.workspace import Workspace
from zerobev.models import BevModel, ZeroBEV, build
from zerobev.training.loader import Source, batches
from zerobev.training.losses import zero_bev_loss
from zerobev.training.precision import computes_bfloat16

_MATMUL = 2048  # side of the matrices whose product is the machine's peak
_COPIED = 2**24  # numbers, float32, whose copy is the machine's bandwidth
_WAITED = 20  # steps in which waiting for data is measured
_PAPER_SAMPLES = 2  # of a step at the paper's sizes: 16 take more memory than a laptop has
#: Operations that reserve memory and do not touch it.
_RESERVING = ("empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided")

Run = Callable[[], Any]


class Machine:
    """The device that everything is measured on, and how time is taken there."""

    def __init__(self) -> None:
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.bfloat16 = computes_bfloat16(self.device.type)

    def autocast(self) -> torch.autocast:
        """As in training."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16)

    def milliseconds(self, runs: dict[str, Run], repeats: int) -> dict[str, dict[str, float]]:
        """Spread of the time of each run. They take turns, so that a slow minute is everybody's."""
        times: dict[str, list[float]] = {name: [] for name in runs}
        for repeat in range(repeats + 1):  # the first one warms up
            for name, run in runs.items():
                start = time.perf_counter()
                run()
                self.finish()
                if repeat:
                    times[name].append(1e3 * (time.perf_counter() - start))
        return {name: spread(values) for name, values in times.items()}

    def finish(self) -> None:
        """Wait for what was started on a GPU."""
        if self.device.type == "cuda":
            torch.cuda.synchronize()

    def batch(self, camera: CameraConfig, samples: int, images: int = 1) -> dict[str, Tensor]:
        """Random tensors of the form of `data.samples`; what is in them takes no time."""
        side, cells = camera.fpv_px, camera.bev_px
        shapes = {"rgb": (3, side), "zero": (images, side), "depth": (1, side), "target": (images, cells)}
        shapes |= {"aux": (2, cells), "fov": (1, cells)}
        random = {name: torch.rand(samples, k, n, n, device=self.device) for name, (k, n) in shapes.items()}
        return {name: image if name in ("rgb", "depth") else image.round() for name, image in random.items()}


def training_step(net: BevModel, batch: dict[str, Tensor], machine: Machine) -> Run:
    """One step as `training.train` takes it: forward, loss, backward, Adam."""
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
    """Forward and backward of each block of the network by itself, on the maps that it gets in a step."""
    with machine.autocast():
        rgb = net.backbone(batch["rgb"])
        fpv = net.fpv_maps(rgb, batch["zero"])
        pyramid = net.pyramid(fpv)
        bev, _ = net.bands(pyramid)
    inputs = {name: _leaves(maps) for name, maps in {"rgb": rgb, "fpv": fpv, "pyramid": pyramid, "bev": [bev]}.items()}
    parts: dict[str, Callable[[], Iterable[Tensor]]] = {
        "backbone": lambda: net.backbone(batch["rgb"]),
        "zero-shot CNN": lambda: net.fpv_maps(inputs["rgb"], batch["zero"]),
        "pyramid": lambda: net.pyramid(inputs["fpv"]),
        "band transformers": lambda: [net.bands(inputs["pyramid"])[0]],
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
    """Floating-point operations of matrix products and convolutions, forward and backward."""
    with FlopCounterMode(display=False) as counter:
        run()
    return counter.get_total_flops()


class _Operations(TorchDispatchMode):
    """Notes the products and the bytes of every operation below it."""

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
    """The least that an operation reads and writes: each tensor once, and nothing where it makes a view."""
    read, written = ([t for t in of if isinstance(t, Tensor)] for of in (inputs, outputs))
    makes_views = not operation._schema.is_mutable and set(map(_storage, written)) <= set(map(_storage, read))
    if makes_views or operation.overloadpacket.__name__ in _RESERVING:
        return 0
    # what is written in place is read there, too: counted once, it is the least
    return sum({t.data_ptr(): min(t.nbytes, t.untyped_storage().nbytes()) for t in (*read, *written)}.values())


def _storage(tensor: Tensor) -> int:
    return tensor.untyped_storage()._cdata


def min_milliseconds(run: Run, peak_tflops: float, bandwidth_gbs: float) -> float:
    """The roofline of `run`: what its operations take if each is held up by products or by memory alone.

    Bytes that an operation finds in a cache are counted as if it did not: small operations can be faster.
    """
    with _Operations() as below:
        run()
    return sum(max(count / peak_tflops / 1e9, size / bandwidth_gbs / 1e6) for count, size in below.noted)


def measure_training(setting: Scale, machine: Machine, repeats: int) -> dict[str, Any]:
    """A step of (c), its blocks, and the drawing of its batch; and what share of the peak and roofline they reach.

    The peak is that of the matrix product of two matrices of 2048 x 2048, in bfloat16 where training computes in it.
    """
    net = build("c", setting.camera, setting.model).to(machine.device)
    assert isinstance(net, ZeroBEV)  # as row (c) is
    batch = machine.batch(setting.camera, setting.train.batch)
    stream, step = _stream(setting), training_step(net, batch, machine)
    numbers = itertools.count()
    drawing = {"batch": lambda: stream.batch(next(numbers))}
    measured = against_the_machine({"step": step} | blocks(net, batch, machine), drawing, machine, repeats)
    waiting = {str(workers): waiting_share(net, stream, machine, workers) for workers in (0, 1)}
    return measured | {"waiting_share": waiting}


def measure_paper_step(machine: Machine, repeats: int) -> dict[str, Any]:
    """A step of (c) at the paper's sizes, of two samples, without dropout; and with it, as the paper has it.

    Torch draws dropout's random numbers one by one on a CPU, which is neither product nor memory.
    """
    paper = scale("paper")
    net = build("c", paper.camera, paper.model).to(machine.device)
    step = training_step(net, machine.batch(paper.camera, _PAPER_SAMPLES), machine)
    steps: dict[str, Run] = {
        "step": partial(_with_dropout, step, net, 0.0),
        "with dropout": partial(_with_dropout, step, net, paper.model.dropout),
    }
    return against_the_machine(steps, {}, machine, repeats)


def _with_dropout(step: Run, net: BevModel, probability: float) -> None:
    for module in net.modules():
        if isinstance(module, nn.Dropout):
            module.p = probability
    step()


def against_the_machine(runs: dict[str, Run], others: dict[str, Run], machine: Machine, repeats: int) -> dict[str, Any]:
    """Time of runs and others, in turns with a matrix product and a copy, and what the runs reach of these two."""
    matrix = torch.rand(_MATMUL, _MATMUL, device=machine.device)
    matrix = matrix.bfloat16() if machine.bfloat16 else matrix
    source, target = torch.rand(2, _COPIED, device=machine.device)
    rates: dict[str, Run] = {"matrix product": lambda: matrix @ matrix, "copy": lambda: target.copy_(source)}
    milliseconds = machine.milliseconds(rates | runs | others, repeats)
    # medians, as of all else: a machine that is shared has moments in which a product is thrice as fast, a step is not
    peak, best = (2 * _MATMUL**3 / milliseconds["matrix product"][of] / 1e9 for of in ("median", "low"))
    bandwidth = 2 * 4 * _COPIED / milliseconds["copy"]["median"] / 1e6
    operations = {name: flops(run) for name, run in runs.items()}
    least = {name: min_milliseconds(run, peak, bandwidth) for name, run in runs.items()}
    return {
        "milliseconds": milliseconds,
        "gigaflops": {name: count / 1e9 for name, count in operations.items()},
        "peak_tflops": peak,
        "best_tflops": best,
        "bandwidth_gbs": bandwidth,
        "share_of_peak": {n: count / milliseconds[n]["median"] / 1e9 / peak for n, count in operations.items()},
        # what they would reach if nothing but products and memory took time
        "roofline_share_of_peak": {n: count / least[n] / 1e9 / peak for n, count in operations.items()},
        "share_of_roofline": {name: least[name] / milliseconds[name]["median"] for name in runs},
    }


def waiting_share(net: BevModel, stream: Source, machine: Machine, workers: int) -> dict[str, float]:
    """The share of a training's time in which it waits for its batches, and the milliseconds of a step with both."""
    drawn = batches(stream, range(_WAITED + 1), machine.device, workers=workers)
    batch = dict(next(drawn))  # which waits for the workers to start
    step = training_step(net, batch, machine)
    waited, ended = 0.0, time.perf_counter()
    started = ended
    for coming in drawn:
        waited += time.perf_counter() - ended
        batch.update(coming)
        step()
        machine.finish()
        ended = time.perf_counter()
    return {"share": waited / (ended - started), "milliseconds": 1e3 * (ended - started) / _WAITED}


def _stream(setting: Scale) -> SynthSamples:
    workspace = Workspace(setting.name)
    samples = (setting.camera, 0, setting.train.batch, setting.empty_fraction)
    return SynthSamples(
        workspace.views("train", 1), workspace.bank(), *samples, extruded_fraction=setting.extruded_fraction
    )


def _leaves(maps: Iterable[Tensor]) -> list[Tensor]:
    return [m.detach().clone().requires_grad_() for m in maps]
