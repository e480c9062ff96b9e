"""The training loop on a small stand-in network: schedule, learning, reproducibility, interruption."""

import json
import logging
import multiprocessing
import os
import signal
import time
from functools import partial
from pathlib import Path

import pytest
import torch
from matplotlib.figure import Figure
from safetensors.torch import load_file, load_model
from torch import Tensor, nn

from zerobev.common.errors import InputError
from zerobev.config import TrainConfig
from zerobev.models.base import MapLogits
from zerobev.training import train as training
from zerobev.training.history import History
from zerobev.training.losses import Losses, dice_loss
from zerobev.training.schedule import Schedule
from zerobev.training.train import dice_objective, train

CONFIG = TrainConfig(steps=20, learning_rate=0.01, decay_every=8, validate_every=6, warmup=3, patience=1, batch=4)


class StandIn(nn.Module):
    """A network of toy size with the interface of the real ones, dropout and running statistics."""

    def __init__(self, dropout: float = 0.2, seed: int = 0):
        super().__init__()
        with torch.random.fork_rng([]):
            torch.manual_seed(seed)
            self.first = nn.Sequential(nn.Conv2d(4, 8, 3, padding=1), nn.BatchNorm2d(8), nn.ReLU())
            self.dropout = nn.Dropout(dropout)
            self.last = nn.Conv2d(8, 3, 3, padding=1)

    def forward(self, rgb: Tensor, zero: Tensor) -> MapLogits:
        maps = self.last(self.dropout(self.first(torch.cat((rgb, zero), dim=1))))
        return MapLogits(maps[:, :1], maps[:, 1:])


def samples(indices: range, size: int = 8) -> dict[str, Tensor]:
    """The map is the zero-shot image shifted by a cell, so that it can be learned."""
    parts = []
    for index in indices:
        generator = torch.Generator().manual_seed(index)
        rgb, zero = (
            torch.rand(3, size, size, generator=generator),
            torch.rand(1, size, size, generator=generator).round(),
        )
        fov = (torch.rand(1, size, size, generator=generator) < 0.8).float()
        parts.append((rgb, zero, zero.roll(1, dims=2), torch.cat((rgb[:1], 1 - rgb[:1])).round(), fov))
    return dict(zip(("rgb", "zero", "target", "aux", "fov"), (torch.stack(part) for part in zip(*parts)), strict=True))


class Samples:
    """Fresh samples for every step."""

    def batch(self, step: int, rank: int = 0, world_size: int = 1) -> dict[str, Tensor]:
        return samples(range(step * CONFIG.batch + rank, (step + 1) * CONFIG.batch, world_size))


class Stuck(Samples):
    """Samples that block at a given step; the file `marker` shows that it is reached."""

    def __init__(self, step: int, marker: Path):
        self.step, self.marker = step, marker

    def batch(self, step: int, rank: int = 0, world_size: int = 1) -> dict[str, Tensor]:
        if step == self.step:
            self.marker.touch()
            time.sleep(60)
        return super().batch(step, rank, world_size)


VALIDATION = [samples(range(10_000, 10_004)), samples(range(10_004, 10_008))]


def run(folder: Path, data=None, seed: int = 0, key: str = "run", **arguments) -> History:
    torch.set_num_threads(1)
    return train(StandIn(), data or Samples(), VALIDATION, CONFIG, folder, seed, key=key, device="cpu", **arguments)


def run_stuck(folder: Path, step: int) -> None:
    """Body of a process that blocks at `step`."""
    training.HISTORY_ENTRIES = 7
    run(folder, Stuck(step, folder / "marker"))


def without_seconds(entries) -> list[dict]:
    return [{name: value for name, value in vars(entry).items() if name != "seconds"} for entry in entries]


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "HISTORY_ENTRIES", 7)
        return folder, run(folder)


def rates(config: TrainConfig, scores: dict[int, float]) -> list[float]:
    """The learning rate of every step, with validations after the steps in `scores`."""
    optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))], lr=config.learning_rate)
    schedule = Schedule(optimizer, config)
    found = []
    for step in range(1, config.steps + 1):
        found.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
        if step in scores:
            schedule.validated(scores[step])
    return found


def test_schedule_by_hand():
    """Warm-up of 4, decay every 3 steps, halved by the second validation in a row without progress."""
    config = TrainConfig(steps=14, learning_rate=1.0, decay_every=3, validate_every=2, warmup=4, patience=1)
    scores = {2: 0.9, 4: 0.5, 6: 0.6, 8: 0.5, 10: 0.55, 12: 0.4}  # halved after step 8; then bad, better
    expected = [0.25, 0.5, 0.75, 0.9, 0.9, 0.9, 0.81, 0.81, 0.405, 0.3645, 0.3645, 0.3645, 0.32805, 0.32805]
    assert rates(config, scores) == pytest.approx(expected)


def test_schedule_without_plateau_or_warmup():
    config = TrainConfig(steps=5, learning_rate=2.0, decay_every=2, validate_every=1, decay=0.5, patience=1)
    improving = {step: 1 / step for step in range(1, 6)}
    assert rates(config, improving) == pytest.approx([2, 2, 1, 1, 0.5])


def test_history_contains_the_schedule_and_the_validations(unbroken):
    """The loop has the learning rates of the schedule; the best validation is chosen."""
    folder, history = unbroken
    validated = [entry for entry in history.entries if entry.validation is not None]
    assert [entry.step for entry in validated] == [6, 12, 18, 20]
    assert [entry.step for entry in history.entries] == [3, 6, 9, 12, 15, 18, 20]
    expected = rates(CONFIG, {entry.step: entry.validation for entry in validated})
    assert [entry.learning_rate for entry in history.entries] == [expected[entry.step - 1] for entry in history.entries]
    best = min(validated, key=lambda entry: entry.validation)
    assert (history.best_step, history.best_score) == (best.step, best.validation)
    for entry in history.entries:
        assert entry.loss == pytest.approx(0.5 * entry.main + 0.5 * entry.aux)
    lines = [json.loads(line) for line in (folder / "history.jsonl").read_text().splitlines()]
    assert lines == [vars(entry) for entry in history.entries]
    assert "step 20 of 20" in (folder / "train.log").read_text()


def test_score_is_the_dice_loss_of_the_best_weights(unbroken):
    """The file contains the weights of the best score."""
    folder, history = unbroken
    model = StandIn()
    load_model(model, folder / "best.safetensors")
    model.eval()
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=bf16()):
        scores = [
            dice_loss(model(b["rgb"], b["zero"]).zero_logits.float().sigmoid(), b["target"], b["fov"]).item()
            for b in VALIDATION
        ]
    assert sum(scores) / 2 == pytest.approx(history.best_score, abs=1e-6)


def bf16() -> bool:
    return any(torch.cpu.get_capabilities().get(name, False) for name in ("avx512_bf16", "amx_bf16"))


def test_best_weights_are_returned_when_scores_get_worse(tmp_path):
    """The objective has its best validation early: the weights are those of that step."""
    scores = iter([0.3, 0.3, 0.1, 0.1, 0.2, 0.2, 0.5, 0.5])
    weights = {}
    model = StandIn()

    def objective(called: nn.Module, batch: dict[str, Tensor]) -> Losses:
        losses = dice_objective(0.5)(called, batch)
        if called.training:
            return losses
        weights[len(weights)] = model.last.weight.detach().clone()
        return losses._replace(main=torch.tensor(next(scores)))

    history = train(model, Samples(), VALIDATION, CONFIG, tmp_path, 0, key="k", objective=objective, device="cpu")
    assert (history.best_step, history.best_score) == (12, pytest.approx(0.1))
    assert torch.equal(model.last.weight, weights[2])
    assert not torch.equal(model.last.weight, weights[6])
    assert not model.training


def test_learns(tmp_path):
    """Eight samples are learned exactly, and the caller's model works as before."""
    eight = samples(range(8))

    class Same:
        def batch(self, step: int, rank: int, world_size: int) -> dict[str, Tensor]:
            return eight

    config = TrainConfig(steps=150, learning_rate=0.03, decay_every=50, validate_every=50)
    model = StandIn(dropout=0)
    history = train(model, Same(), [eight], config, tmp_path, 0, key="k", device="cpu")
    assert history.best_score < 0.05
    assert history.entries[0].main > 0.3
    assert "forward" not in vars(model), "the model is not wrapped any more"
    predicted = model(eight["rgb"], eight["zero"]).zero_logits.sigmoid()
    assert dice_loss(predicted, eight["target"], eight["fov"]) < 0.05


def test_pictures_are_drawn_at_every_validation(tmp_path):
    """Curves always; a sample of the first validation batch if the caller draws one."""
    seen = []

    def picture(model: nn.Module, batch: dict[str, Tensor]) -> Figure:
        seen.append((model.training, torch.equal(batch["zero"], VALIDATION[0]["zero"])))
        return Figure()

    run(tmp_path, picture=picture)
    assert seen == [(False, True)] * 4  # steps 6, 12, 18 and 20
    assert {"curves.png", "sample.png"} <= {path.name for path in tmp_path.iterdir()}


def test_same_seed_same_bytes(unbroken, tmp_path):
    """Another seed differs (dropout); the caller's generator is unchanged."""
    folder, _ = unbroken
    before = torch.get_rng_state()
    run(tmp_path / "again")
    assert torch.equal(torch.get_rng_state(), before)
    run(tmp_path / "other", seed=1)
    files = [(path / "best.safetensors").read_bytes() for path in (folder, tmp_path / "again", tmp_path / "other")]
    assert files[0] == files[1]
    assert files[0] != files[2]


def test_workers_that_draw_the_batches_change_no_weight(unbroken, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "batches", partial(training.batches, workers=2))
    run(tmp_path)
    assert (tmp_path / "best.safetensors").read_bytes() == (unbroken[0] / "best.safetensors").read_bytes()


def resume(folder: Path, unbroken: tuple[Path, training.History]) -> list[int]:
    """Resume in `folder`, compare the result with the unbroken run, and return the trained steps."""
    asked = []

    class Recorded(Samples):
        def batch(self, step: int, rank: int = 0, world_size: int = 1) -> dict[str, Tensor]:
            asked.append(step)
            return super().batch(step, rank, world_size)

    history = run(folder, Recorded())
    whole, expected = unbroken
    assert (folder / "best.safetensors").read_bytes() == (whole / "best.safetensors").read_bytes()
    assert without_seconds(history.entries) == without_seconds(expected.entries)
    seconds = [entry.seconds for entry in history.entries]
    assert seconds == sorted(seconds), "the clock resumes at its last value"
    assert len((folder / "history.jsonl").read_text().splitlines()) == len(expected.entries)
    ours, theirs = (torch.load(path / "checkpoint.pt", weights_only=True) for path in (folder, whole))
    for name, value in theirs["model"].items():
        assert torch.equal(ours["model"][name], value), name
    for index, state in theirs["optimizer"]["state"].items():
        for name, value in state.items():
            assert torch.equal(ours["optimizer"]["state"][index][name], value)
    return asked


@pytest.mark.slow
def test_killed_and_resumed(unbroken, tmp_path, monkeypatch):
    """SIGKILL during the 17th step: resumed after the validation of the 12th, with the same result."""
    process = multiprocessing.get_context("spawn").Process(target=run_stuck, args=(tmp_path, 16))
    process.start()
    deadline = time.monotonic() + 60
    while not ((tmp_path / "marker").exists() and len((tmp_path / "history.jsonl").read_text().splitlines()) == 5):
        assert process.is_alive() and time.monotonic() < deadline
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert not (tmp_path / "best.safetensors").exists()
    monkeypatch.setattr(training, "HISTORY_ENTRIES", 7)
    assert resume(tmp_path, unbroken) == [12, 13, 14, 15, 16, 17, 18, 19]


def test_resumed_between_validations(unbroken, tmp_path, monkeypatch):
    """A checkpoint between history entries, after an error in the data."""

    class Broken(Samples):
        def batch(self, step: int, rank: int = 0, world_size: int = 1) -> dict[str, Tensor]:
            if step == 17:
                raise OSError("the disk went away")
            return super().batch(step, rank, world_size)

    monkeypatch.setattr(training, "HISTORY_ENTRIES", 7)
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0)
    with pytest.raises(OSError, match="the disk went away"):
        run(tmp_path, Broken())
    first = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["step"]
    assert first == 17
    assert resume(tmp_path, unbroken) == list(range(first, 20))


def test_finished_run_is_not_repeated(unbroken, tmp_path):
    """The same call again trains no step and returns the same."""

    class Nothing:
        def batch(self, step: int, rank: int, world_size: int) -> dict[str, Tensor]:
            raise AssertionError("no step is left")

    first = run(tmp_path)
    model = StandIn(seed=1)
    again = train(model, Nothing(), VALIDATION, CONFIG, tmp_path, 0, key="run", device="cpu")
    assert again == first
    for name, value in load_file(tmp_path / "best.safetensors").items():
        assert torch.equal(model.state_dict()[name], value)


def test_checkpoint_of_another_run(tmp_path):
    run(tmp_path)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    with pytest.raises(
        InputError, match=r"checkpoint.pt: expected a checkpoint of the run 'other', found one of 'run'"
    ):
        run(tmp_path, key="other")
    assert (tmp_path / "checkpoint.pt").read_bytes() == before


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "text"])
def test_damaged_checkpoint(unbroken, tmp_path, caplog, damage):
    """Reported in the log; the run starts again, with the same result."""
    folder, _ = unbroken
    whole = (folder / "checkpoint.pt").read_bytes()
    middle = len(whole) // 2
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(
        {
            "truncated": whole[:middle],
            "flipped": whole[:middle]
            + bytes(255 - byte for byte in whole[middle : middle + 64])
            + whole[middle + 64 :],
            "empty": b"",
            "text": b"not a checkpoint",
        }[damage]
    )
    with caplog.at_level(logging.WARNING):
        run(tmp_path)
    assert "checkpoint.pt cannot be read" in caplog.text
    assert "training starts from the first step" in (tmp_path / "train.log").read_text()
    assert (tmp_path / "best.safetensors").read_bytes() == (folder / "best.safetensors").read_bytes()


def test_divergence_is_an_error(tmp_path):
    class Broken(Samples):
        def batch(self, step: int, rank: int = 0, world_size: int = 1) -> dict[str, Tensor]:
            batch = super().batch(step, rank, world_size)
            return {**batch, "rgb": batch["rgb"] * (float("nan") if step == 2 else 1)}

    with pytest.raises(FloatingPointError, match="step 3"):
        run(tmp_path, Broken())


def test_device_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="device: expected"):
        train(StandIn(), Samples(), VALIDATION, CONFIG, tmp_path, 0, key="k", device="meta")
