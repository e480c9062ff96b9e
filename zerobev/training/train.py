"""One training loop for every learned model, on a CPU or on GPUs (paper, "Implementation and training details").

A step is a pure function of the state before it and of (seed, step): batches are addressed by step, and torch's
generator is seeded before every step. A run that is killed and resumed therefore has the same final weights as an
uninterrupted one.

Several processes (`accelerate launch`) divide each batch; its total size stays as configured. Up to rounding, the steps
are those of one process, with two exceptions: dropout differs, and on a CPU batch norms use the samples of one process
(on GPUs those of all). All processes need access to the same folder.
"""

import json
import logging
import pickle
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator, PartialState
from accelerate.state import AcceleratorState
from matplotlib.figure import Figure
from safetensors.torch import save_model
from torch import Tensor, distributed, nn

from zerobev.common.errors import InputError
from zerobev.common.memory import keep_freed_memory
from zerobev.common.progress import progress
from zerobev.common.storage import replacing
from zerobev.config import AUX, TrainConfig
from zerobev.training.history import Entry, History, columns
from zerobev.training.loader import Batch, Source, batches, model_inputs, moved
from zerobev.training.losses import Losses, zero_bev_loss
from zerobev.training.monitor import curves_figure, write_picture
from zerobev.training.precision import computes_bfloat16
from zerobev.training.schedule import Schedule

CHECKPOINT_SECONDS = 60  #: between two checkpoints, apart from those at validations
HISTORY_ENTRIES = 200  #: approximate number per run, apart from validations

Objective = Callable[[nn.Module, Batch], Losses]
Picture = Callable[[nn.Module, Batch], Figure]
log = logging.getLogger("zerobev.train")


def dice_objective(alpha: float, aux: tuple[str, ...] = AUX) -> Objective:
    """`zero_bev_loss` of a model called as `model(rgb, zero, depth)`, without depth if the batch has none."""
    return lambda model, batch: zero_bev_loss(model(*model_inputs(batch)), batch, alpha, aux)


def train(
    model: nn.Module,
    data: Source,
    validation: Sequence[Batch],
    config: TrainConfig,
    folder: Path,
    seed: int,
    *,
    key: str,
    objective: Objective | None = None,
    picture: Picture | None = None,
    device: torch.device | str | None = None,
) -> History:
    """Train `model` in place; afterwards it is on the device, in evaluation mode, with the best validated weights.

    model: with initial weights, drawn from the seed by the caller
    validation: fixed batches; their mean `main` loss is the score, lower is better: for Zero-BEV the Dice loss of the
        zero-shot stream. Unlike an IoU it has no threshold, so it changes from the start of training. On *Synth*
        textures it needs no semantic label: the choice of weights stays zero-shot.
    folder: for `checkpoint.pt`, `best.safetensors` (at the end), `history.jsonl`, `train.log`, and, at every
        validation, `curves.png` and `sample.png`
    seed: of dropout; `data` has another
    key: name of the run. Training resumes from a checkpoint with this key. A checkpoint with another key raises
        `InputError`; an unreadable one is reported in the log and replaced.
    objective: losses of a batch; default: `dice_objective(config.alpha)`
    picture: draws the first validation batch and the model's output, for `sample.png`
    device: default: a GPU if there is one. Forward passes are in bfloat16 if the processor computes in it.
    """
    keep_freed_memory()
    accelerator = training_accelerator(device)
    objective = objective or dice_objective(config.alpha)
    forked = [accelerator.device] if accelerator.device.type == "cuda" else []
    with torch.random.fork_rng(forked), _logged(folder / "train.log", accelerator.is_main_process):
        run = _Run(model, config, folder, key, accelerator)
        try:
            run.resume()
            steps = range(run.step, config.steps)
            processes = accelerator.process_index, accelerator.num_processes
            with closing(batches(data, steps, accelerator.device, *processes)) as drawn:
                shown = progress(drawn, "training", "step", config.steps, done=run.step)
                for batch in shown if accelerator.is_main_process else drawn:
                    torch.manual_seed(_step_seed(seed, run.step, accelerator.process_index))
                    run.advance(objective, batch)
                    if run.step % config.validate_every == 0 or run.step == config.steps:
                        run.validate(objective, validation)
                        run.show(picture, validation[0])
                    elif run.step % -(-config.steps // HISTORY_ENTRIES) == 0:
                        run.record(None)
                    run.checkpoint_if_due()
            return run.finish()
        finally:
            accelerator.unwrap_model(run.model, keep_fp32_wrapper=False)
            vars(model).pop("forward", None)  # unwrapping leaves the method on the instance


class _Run:
    """State of a training, its checkpoints and its history."""

    def __init__(self, model: nn.Module, config: TrainConfig, folder: Path, key: str, accelerator: Accelerator) -> None:
        if accelerator.num_processes > 1 and accelerator.device.type == "cuda":
            nn.SyncBatchNorm.convert_sync_batchnorm(model)  # in place; torch supports it only on GPUs
        self.bare = model
        self.config, self.folder, self.key, self.accelerator = config, folder, key, accelerator
        optimizer = torch.optim.Adam(
            model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, fused=True
        )
        self.schedule = Schedule(optimizer, config)
        self.model, self.optimizer = accelerator.prepare(model, optimizer)
        self.step = 0
        self.best: dict[str, Tensor] = {}
        self.best_step, self.best_score = 0, float("inf")
        self.entries: list[Entry] = []
        self.window: list[list[float]] = []  # losses since the last entry
        self.unread: list[Tensor] = []  # later losses, still on the device
        self.learning_rate = config.learning_rate  # of the last step
        self._seconds_before, self._started = 0.0, time.monotonic()
        self._saved_at = self._started

    @property
    def seconds(self) -> float:
        return self._seconds_before + time.monotonic() - self._started

    def advance(self, objective: Objective, batch: Batch) -> None:
        """One step of the optimiser."""
        self.model.train()
        self.learning_rate = self.optimizer.param_groups[0]["lr"]
        losses = objective(self.model, batch)
        self.accelerator.backward(losses.total)
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.schedule.step()
        self.step += 1
        # read later: reading a result at every step would stall a GPU
        self.unread.append(self._means(torch.stack([value.detach() for value in losses if value is not None])))

    def validate(self, objective: Objective, batches: Sequence[Batch]) -> None:
        """Score the model, copy its weights if it is the best so far, and save a checkpoint."""
        self.model.eval()
        rank, world_size = self.accelerator.process_index, self.accelerator.num_processes
        with torch.no_grad():
            parts = ({name: value[rank::world_size] for name, value in batch.items()} for batch in batches)
            scores = [objective(self.model, moved(part, self.accelerator.device)).main for part in parts]
            score = float(np.mean(self._means(torch.stack(scores)).tolist()))
        self.schedule.validated(score)
        if score < self.best_score:
            self.best = {name: value.detach().cpu().clone() for name, value in self.bare.state_dict().items()}
            self.best_step, self.best_score = self.step, score
        self.record(score)
        self.save()

    def _means(self, values: Tensor) -> Tensor:
        """Means over processes, so that all choose the same weights and lower the rate at the same step."""
        return self.accelerator.reduce(values, reduction="mean")

    def show(self, picture: Picture | None, batch: Batch) -> None:
        """Draw the curves so far, and the model's output on a batch."""
        if not self.accelerator.is_main_process:
            return
        write_picture(curves_figure(columns(self.entries)), self.folder / "curves.png")
        if picture is not None:
            write_picture(picture(self.bare, moved(batch, self.accelerator.device)), self.folder / "sample.png")

    def read_losses(self) -> None:
        """Move the losses of the last steps into the window. Raises `FloatingPointError` if one is not finite."""
        if not self.unread:
            return
        first = self.step - len(self.unread) + 1
        for step, values in enumerate(torch.stack(self.unread).tolist(), first):
            if not np.isfinite(values).all():
                raise FloatingPointError(f"step {step}: expected finite losses, found {values}")
            self.window.append(values)
        self.unread.clear()

    def record(self, score: float | None) -> None:
        """Add an entry to the history, its file and the log."""
        self.read_losses()
        total, main, *aux = np.mean(self.window, axis=0).tolist()
        entry = Entry(self.step, total, main, aux[0] if aux else None, self.learning_rate, self.seconds, score)
        self.window.clear()
        self.entries.append(entry)
        if self.accelerator.is_main_process:
            with (self.folder / "history.jsonl").open("a") as file:
                file.write(json.dumps(asdict(entry)) + "\n")
        validated = "" if score is None else f", validation {score:.4f} (best {self.best_score:.4f})"
        log.info("step %d of %d, %.0f s: loss %.4f%s", self.step, self.config.steps, self.seconds, total, validated)

    def checkpoint_if_due(self) -> None:
        """Save if the last checkpoint is older than `CHECKPOINT_SECONDS`."""
        if time.monotonic() - self._saved_at > CHECKPOINT_SECONDS:
            self.save()

    def save(self) -> None:
        """Write the checkpoint atomically."""
        self.read_losses()
        self._saved_at = time.monotonic()
        if not self.accelerator.is_main_process:
            return
        state = {
            "key": self.key,
            "step": self.step,
            "model": self.bare.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "schedule": self.schedule.state_dict(),
            "best": self.best,
            "best_step": self.best_step,
            "best_score": self.best_score,
            "entries": [asdict(entry) for entry in self.entries],
            "window": self.window,
            "seconds": self.seconds,
        }
        with replacing(self.folder / "checkpoint.pt") as temporary:
            torch.save(state, temporary)

    def resume(self) -> None:
        """Load the folder's checkpoint if there is one, and rewrite the history's file."""
        state = _read_checkpoint(self.folder / "checkpoint.pt", self.key)
        if state is not None:
            self.bare.load_state_dict(state["model"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.schedule.load_state_dict(state["schedule"])
            self.step, self.best, self.window = state["step"], state["best"], state["window"]
            self.best_step, self.best_score = state["best_step"], state["best_score"]
            self.entries = [Entry(**entry) for entry in state["entries"]]
            self._seconds_before = state["seconds"]
            log.info("resumed at step %d", self.step)
        if self.accelerator.is_main_process:
            with replacing(self.folder / "history.jsonl") as temporary:
                temporary.write_text("".join(json.dumps(asdict(entry)) + "\n" for entry in self.entries))

    def finish(self) -> History:
        """Load the best weights and write them."""
        self.bare.load_state_dict(self.best)
        self.bare.eval()
        if self.accelerator.is_main_process:
            with replacing(self.folder / "best.safetensors") as temporary:
                save_model(self.bare, str(temporary))
        return History(tuple(self.entries), self.best_step, self.best_score, self.entries[-1].seconds)


def _read_checkpoint(path: Path, key: str) -> dict[str, Any] | None:
    """The checkpoint; None if it is missing or unreadable."""
    if not path.exists():
        return None
    try:
        with zipfile.ZipFile(path) as archive:  # torch does not verify checksums
            damaged = archive.testzip()
        if damaged:
            raise zipfile.BadZipFile(f"wrong checksum of {damaged}")
        state = torch.load(path, map_location="cpu", weights_only=True)
        found = state["key"]
    except (zipfile.BadZipFile, RuntimeError, OSError, KeyError, TypeError, pickle.UnpicklingError) as error:
        log.warning("%s cannot be read (%r): training starts from the first step", path, error)
        return None
    if found != key:
        raise InputError(f"{path}: expected a checkpoint of the run {key!r}, found one of {found!r}")
    return state


def _step_seed(seed: int, step: int, rank: int) -> int:
    return int(np.random.SeedSequence([seed, step, rank]).generate_state(1, np.uint64)[0])


def training_accelerator(device: torch.device | str | None = None) -> Accelerator:
    """An accelerator on the given device (default: a GPU if there is one), in bfloat16 if the device computes in it.

    Raises `InputError` for a device missing on this machine.
    """
    wanted = None if device is None else torch.device(device).type
    kind = "cuda" if torch.cuda.is_available() and wanted != "cpu" else "cpu"
    if PartialState._shared_state and not distributed.is_initialized() and PartialState().device.type != kind:
        # accelerate otherwise stays on the first device used by the process
        AcceleratorState._reset_state(reset_partial_state=True)
    accelerator = Accelerator(cpu=kind == "cpu", mixed_precision="bf16" if computes_bfloat16(kind) else "no")
    if wanted not in (None, accelerator.device.type):
        raise InputError(f"device: expected {accelerator.device.type}, the one at hand, found {wanted}")
    return accelerator


@contextmanager
def _logged(path: Path, main: bool) -> Iterator[None]:
    """Also write the log of the main process to `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handler = logging.FileHandler(path) if main else logging.NullHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    level = log.level
    log.setLevel(logging.INFO)
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
        handler.close()
