"""Every network of the paper's tables: size, interface, shared parts, checkpoints, learning."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from zerobev import cli
from zerobev.common.errors import InputError
from zerobev.config import AUX, LABELS, SCALES, CameraConfig
from zerobev.geometry.projection import inverse_project, map_points
from zerobev.models import VARIANTS, BevModel, ZeroBEV, build, load_model
from zerobev.models.fpv_to_bev import reweigh
from zerobev.models.max_pooling import binary_or, closing, noisy_or
from zerobev.models.polar import band_rows
from zerobev.report.paper import PARAMETERS_M
from zerobev.report.parameters import parameters
from zerobev.training.losses import dice_loss, zero_bev_loss

SMOKE = SCALES["smoke"]
ROWS = list(VARIANTS)
ZERO_SHOT = ["-", "c", "d", "e", "f", "f.r"]
CLASSES = len(LABELS)


@pytest.fixture(autouse=True)
def seeded():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def network(row: str, camera: CameraConfig = SMOKE.camera, **changes) -> BevModel:
    """A network of the smoke scale in evaluation mode, with batch-norm statistics other than 0 and 1."""
    net = build(row, camera, replace(SMOKE.model, **changes)).eval()
    for module in net.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.uniform_(-0.2, 0.2)
            module.running_var.uniform_(0.5, 2.0)
    return net


def inputs(batch: int, k: int = CLASSES, side: int = 32) -> tuple[Tensor, Tensor, Tensor]:
    zero = (torch.rand(batch, k, side, side) > 0.7).float()
    return torch.rand(batch, 3, side, side), zero, 0.3 + 5 * torch.rand(batch, 1, side, side)


@pytest.mark.parametrize("row", ROWS)
def test_initial_maps_have_the_foreground_prior_and_auxiliary_maps_one_half(row):
    """The prior shifts the logits of the main maps by its logit, and changes no auxiliary map."""
    rgb, zero, depth = inputs(2)
    results = []
    for prior in (0.5, 0.1):
        torch.manual_seed(0)
        with torch.no_grad():
            results.append(network(row, foreground_prior=prior)(rgb, zero, depth))
    shift = torch.full_like(results[0].zero_logits, float(np.log(0.1 / 0.9)))
    assert torch.allclose(results[1].zero_logits - results[0].zero_logits, shift, atol=1e-5)
    if results[0].aux_logits is not None:
        assert torch.equal(results[0].aux_logits, results[1].aux_logits)


def views(n: int, camera: CameraConfig) -> dict[str, Tensor]:
    """A batch of `n` views of a floor of coloured squares in front of a wall, cast by hand; the colour is the class.

    The zero-shot image is white on three of the classes.
    """
    side, far = camera.bev_px, camera.bev_extent_m
    wall = torch.linspace(2.2, 4.4, n)[:, None, None]
    squares = torch.randint(0, CLASSES, (n, 5, 5))  # of 1 m
    _, y, z = map_points(torch.ones(1, camera.fpv_px, camera.fpv_px), camera)[0].unbind(-1)
    floor = camera.height_m / (camera.height_m - z).clamp(min=1e-3)  # depth at which a ray meets the floor
    depth = torch.minimum(floor * y, wall)
    x = map_points(depth, camera)[..., 0]
    cells = (torch.arange(side) + 0.5) * camera.cell_m
    cell_x, cell_z = torch.meshgrid(cells - far / 2, cells.flip(0), indexing="xy")

    def label(x: Tensor, z: Tensor) -> Tensor:
        row, column = (4 - z.floor().long()).clamp(0, 4), (x + far / 2).floor().long().clamp(0, 4)
        return squares[torch.arange(n)[:, None, None], row, column]

    cell_x, cell_z = cell_x.expand(n, -1, -1), cell_z.expand(n, -1, -1)
    image, above = (
        F.one_hot(label(*where), CLASSES).movedim(-1, 1).float() for where in ((x, depth), (cell_x, cell_z))
    )
    fov = (cell_z <= wall) & (cell_x.abs() <= cell_z * camera.fpv_px / 2 / camera.focal_px)
    obstacle = (wall - cell_z).abs() < camera.cell_m
    return {
        "rgb": torch.einsum("nkhw,kc->nchw", image, torch.rand(CLASSES, 3)),
        "depth": depth[:, None],
        "classes": image,
        "class_maps": above,
        "zero": image[:, :3].sum(1, keepdim=True),
        "target": above[:, :3].sum(1, keepdim=True),
        "aux": torch.stack([obstacle, ~obstacle], dim=1).float(),
        "fov": fov[:, None].float(),
    }


# --- size


@pytest.mark.parametrize("row", PARAMETERS_M)
def test_parameters_at_paper_scale_are_the_papers(row):
    paper = SCALES["paper"]
    with torch.device("meta"):
        table = parameters(build(row, paper.camera, paper.model))
    assert table["total"] == pytest.approx(PARAMETERS_M[row] * 1e6, rel=0.03)
    if row != "b.1":
        assert table["decoder"] == pytest.approx(5.20e6, rel=0.002)
        assert table["bands"] == pytest.approx(8.97e6, rel=0.005)
        assert table["backbone"] == pytest.approx(23.5e6, rel=0.002)


def test_command_prints_every_block_and_writes_every_total(tmp_path, capsys):
    file = tmp_path / "table.json"
    cli.main(["parameters", "--scale", "smoke", "--json", str(file)])
    written, printed = json.loads(file.read_text()), capsys.readouterr().out
    assert written == {row: sum(p.numel() for p in network(row).parameters()) for row in ROWS}
    for count in parameters(network("d")).values():
        assert f"{count:,}" in printed
    with pytest.raises(SystemExit, match="error: scale: expected"):
        cli.main(["parameters", "--scale", "huge"])


@pytest.mark.slow
@pytest.mark.parametrize("row", ["b.1", "b.3", "d", "e", "f.r"])
def test_one_sample_passes_forward_and_backward_at_paper_scale(row):
    paper = SCALES["paper"]
    net = build(row, paper.camera, paper.model)
    out = net(*inputs(1, CLASSES if row == "b.3" else 1, 384))
    assert out.zero_logits.shape == (1, CLASSES if row[0] == "b" else 1, 100, 100)
    sum(x.square().mean() for x in out if x is not None).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())


# --- contract


@pytest.mark.parametrize("row", ROWS)
def test_shapes_and_gradients_of_every_parameter(row):
    net = network(row).train()
    out = net(*inputs(2))
    assert out.zero_logits.shape == (2, 8, 20, 20)
    aux = net.config.aux
    assert (out.aux_logits is None) if not aux else (out.aux_logits.shape == (2, len(aux), 20, 20))
    sum(x.square().sum() for x in out if x is not None).backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()] == []


@torch.no_grad()
@pytest.mark.parametrize("row", ["b.1", "b.2", "b.3", "d", "e", "f.r"])
def test_a_batch_of_one_equals_a_batch_of_many(row):
    net, images = network(row), inputs(3)
    together = net(*images)
    for i in range(3):
        alone = net(*(image[i : i + 1] for image in images))
        for ours, theirs in zip(alone, together):
            assert ours is theirs is None or torch.allclose(ours[0], theirs[i], atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("row", ["b.1", "b.3", "d", "e", "f.r"])
@pytest.mark.parametrize(("fpv", "bev", "stem"), [(97, 25, 4), (50, 33, 2)])
def test_any_grid(row, fpv, bev, stem):
    camera = CameraConfig(fpv_px=fpv, bev_px=bev, hfov_deg=62, bev_extent_m=4.0)
    net = network(row, camera, stem_stride=stem, band_edges_m=(0, 0.7, 1.5, 2.9, 4.0))
    out = net(*inputs(2, side=fpv))
    assert out.zero_logits.shape == (2, 8, bev, bev) and out.zero_logits.isfinite().all()


@pytest.mark.parametrize("row", ["b.1", "c", "e", "f"])
def test_a_batch_of_one_can_be_trained_on(row):
    net = network(row).train()
    net(*inputs(1)).zero_logits.sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in net.parameters())


@torch.no_grad()
def test_inputs_used_by_each_network():
    """VPN and TIM use only the RGB image, TIM with segmentation the masks too; only residual variants use depth."""
    rgb, zero, depth = inputs(2)
    for row, reads_zero, reads_depth in (
        *(("b.1", False, False), ("b.2", False, False), ("b.3", True, False)),
        *(("c", True, False), ("d", True, True), ("e", True, False), ("f", True, False), ("f.r", True, True)),
    ):
        net = network(row)
        seen = net(rgb, zero, depth).zero_logits
        assert torch.equal(net(rgb, zero.roll(1, 3), depth).zero_logits, seen) != reads_zero
        assert torch.equal(net(rgb, zero, depth / 2).zero_logits, seen) != reads_depth
        assert not torch.equal(net(rgb.roll(1, 3), zero, depth).zero_logits, seen)


@pytest.mark.parametrize(
    ("row", "bad", "named"),
    [
        ("b.1", {"rgb": (2, 3, 32, 30)}, "rgb"),
        ("b.2", {"rgb": (2, 1, 32, 32)}, "rgb"),
        ("b.3", {"zero": (2, 3, 32, 32)}, "zero"),
        ("b.3", {"zero": None}, "zero"),
        ("c", {"zero": (2, 32, 32)}, "zero"),
        ("d", {"depth": None}, "depth"),
        ("d", {"depth": (2, 1, 16, 16)}, "depth"),
        ("e", {"zero": (1, 8, 32, 32)}, "zero"),
    ],
)
def test_wrong_inputs_are_named(row, bad, named):
    images = dict(zip(("rgb", "zero", "depth"), inputs(2)))
    images |= {name: None if shape is None else torch.rand(shape) for name, shape in bad.items()}
    with pytest.raises(InputError, match=f"^{named}: expected"):
        network(row)(**images)


def test_wrong_configurations_are_named():
    with pytest.raises(InputError, match="aux: expected at least one"):
        network("e", aux=())
    for aux in (("floor",), AUX[::-1]):
        with pytest.raises(InputError, match="aux: expected maps among"):
            ZeroBEV(SMOKE.camera, replace(SMOKE.model, aux=aux))
    with pytest.raises(InputError, match="band_edges_m: expected 5 depths"):
        network("c", band_edges_m=(0.0, 1.0, 2.0, 3.0, 4.0, 5.0))
    with pytest.raises(InputError, match="row: expected one of"):
        network("z")


# --- several modalities


@torch.no_grad()
@pytest.mark.parametrize("row", ZERO_SHOT)
@pytest.mark.parametrize("batch", [1, 3])
def test_modalities_share_only_the_rgb_features(row, batch):
    net, (rgb, zero, depth), calls = network(row), inputs(batch), []
    hook = net.backbone.register_forward_hook(lambda *_: calls.append(1))
    together = net(rgb, zero, depth)
    hook.remove()
    assert len(calls) == 1
    passes = [net(rgb, zero[:, k : k + 1], depth) for k in range(CLASSES)]
    assert torch.allclose(together.zero_logits, torch.cat([p.zero_logits for p in passes], 1), atol=1e-5)
    order = torch.randperm(CLASSES)
    permuted = net(rgb, zero[:, order], depth)
    assert torch.allclose(permuted.zero_logits, together.zero_logits[:, order], atol=1e-5)
    if net.config.aux:
        assert torch.allclose(together.aux_logits, torch.stack([p.aux_logits for p in passes]).mean(0), atol=1e-5)
        assert torch.allclose(permuted.aux_logits, together.aux_logits, atol=1e-5)


# --- residual variant


@torch.no_grad()
def test_the_residual_is_an_embedding_of_the_projection_added_to_the_map_features():
    net, (rgb, zero, depth), seen = network("d"), inputs(2, 3), []
    net.decoder.register_forward_pre_hook(lambda _, features: seen.append(features[0]))
    net(rgb, zero, depth)
    features, _ = net.bands(net.fpv_maps(net.rgb_laterals(rgb), zero))
    known = inverse_project(zero, depth, net.camera).flatten(0, 1)[:, None]  # N 1 M M
    assert 0.01 < known.mean() < 0.99
    weight, bias = net.embedding.weight[:, 0], net.embedding.bias[:, None, None]
    assert torch.allclose(seen[0], features + weight * known + bias, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("row", ["d", "f.r"])
def test_a_residual_network_may_know_which_cells_depth_shows(row):
    """Without depth, P^-1 of a white image and of a black one are both empty; the cells seen tell the two apart."""
    model = replace(SMOKE.model, seen=True)
    net = build(row, SMOKE.camera, model).eval()
    seen = []
    net.decoder.register_forward_pre_hook(lambda _, features: seen.append(features[0]))
    rgb, black = torch.rand(1, 3, 32, 32), torch.zeros(1, 1, 32, 32)
    for depth in (torch.zeros(1, 1, 32, 32), torch.full((1, 1, 32, 32), 2.0)):
        net(rgb, black, depth)
    cells = inverse_project(torch.ones_like(black), torch.full((1, 1, 32, 32), 2.0), net.camera)[:, 0]
    changed = (seen[0] != seen[1]).any(dim=1)
    assert cells.any() and torch.equal(changed, cells > 0)


@torch.no_grad()
@pytest.mark.parametrize("row", ["d", "f.r"])
def test_a_residual_network_may_know_which_cells_are_measured(row):
    """The same depth, measured in the left half of the image or not at all: features of that half's cells differ."""
    net, seen = build(row, SMOKE.camera, replace(SMOKE.model, seen=True, measured=True)).eval(), []
    net.decoder.register_forward_pre_hook(lambda _, features: seen.append(features[0]))
    rgb, zero, depth = torch.rand(1, 3, 32, 32), torch.zeros(1, 1, 32, 32), torch.full((1, 1, 32, 32), 2.0)
    left = torch.zeros_like(depth)
    left[..., :16] = 1
    for of in (depth, torch.cat([depth, torch.zeros_like(depth)], dim=1), torch.cat([depth, left], dim=1)):
        net(rgb, zero, of)
    cells = inverse_project(left, depth, net.camera)[:, 0] > 0
    assert torch.equal(seen[0], seen[1])  # without a mask nothing is measured
    assert cells.any() and torch.equal((seen[2] != seen[0]).any(dim=1), cells)


# --- inductive bias


@torch.no_grad()
def test_reweigh_sums_columns_weighted_by_attention():
    """Two RGB images with three zero-shot images each: position p of column c is the weighted sum of its head."""
    cross = torch.rand(2 * 5, 4, 6, 7).softmax(-1)
    values = torch.rand(2 * 3, 8, 7, 5)
    rays = reweigh(cross, values)
    assert rays.shape == (6, 5, 6, 8)
    for image, column, p, channel in ((0, 0, 0, 0), (2, 4, 5, 7), (3, 1, 2, 3), (5, 3, 0, 6)):
        weights = cross[5 * (image // 3) + column, channel // 2, p]
        assert torch.allclose(rays[image, column, p, channel], (weights * values[image, channel, :, column]).sum())


@torch.no_grad()
def test_attention_depends_only_on_the_rgb_image():
    """Auxiliary maps do not depend on the zero-shot image; features of its map are linear in those of the zero CNN."""
    net, (rgb, zero, _), seen = network("e"), inputs(2, 1), []
    assert torch.equal(net(rgb, zero).aux_logits, net(rgb, 1 - zero).aux_logits)
    net.zero_cnn.register_forward_hook(lambda _m, _i, maps: [2 * features for features in maps])
    net.decoder.register_forward_pre_hook(lambda _, features: seen.append(features[0][2:]))
    net(rgb, zero)
    net.zero_cnn._forward_hooks.clear()
    net(rgb, zero)
    net.zero_cnn.register_forward_hook(lambda _m, _i, maps: [0 * features for features in maps])
    net(rgb, zero)
    twice, once, none = seen
    assert torch.allclose(twice - none, 2 * (once - none), atol=1e-5) and not torch.equal(once, none)


@torch.no_grad()
@pytest.mark.parametrize("row", ["b.2", "b.3", "d", "e"])
def test_cross_attention_of_any_column_and_position(row):
    net, (rgb, zero, _) = network(row), inputs(2, 8 if row == "b.3" else 1)
    for attention, rows, count in zip(
        net.attention(rgb, zero), band_rows(net.camera, net.config.band_edges_m), (2, 4, 8, 16)
    ):
        weights = attention.cross[-1].unflatten(0, (2, -1))
        assert weights.shape == (2, count, 4, len(rows), count)
        assert torch.allclose(weights.sum(-1), torch.ones(()), atol=1e-5)


# --- max-pooling attention


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_noisy_or_max_pools_the_values_of_open_gates(seed):
    """For binary gates and values: the maximum over the pixels with open gates."""
    rng = np.random.default_rng(seed)
    open_, values = rng.random((3, 5, 7)) < 0.3, rng.random((3, 7, 4)) < 0.5
    logits = torch.from_numpy(np.where(open_, 40.0, -40.0)).float()
    expected = (open_[..., None] & values[:, None]).any(axis=2)
    found = noisy_or(logits, torch.from_numpy(values).float())
    torch.testing.assert_close(found, torch.from_numpy(expected).float(), atol=1e-6, rtol=0)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_noisy_or_is_between_the_largest_term_and_the_sum_and_is_monotone(seed):
    torch.manual_seed(seed)
    logits, values = 3 * torch.randn(2, 5, 7), torch.rand(2, 7, 4)
    terms = logits.sigmoid()[..., None] * values[:, None]  # 2 5 7 4
    found = noisy_or(logits, values)
    torch.testing.assert_close(found, 1 - (1 - terms).prod(2), atol=1e-5, rtol=1e-5)
    assert (found >= terms.amax(2) - 1e-5).all() and (found <= terms.sum(2) + 1e-5).all()
    raised = values.clone()
    raised[:, 3] += (1 - raised[:, 3]) / 2
    assert (noisy_or(logits, raised) >= found - 1e-6).all()
    order = torch.randperm(4)
    torch.testing.assert_close(noisy_or(logits, values[..., order]), found[..., order])
    # the faster form for binary values is the same function
    binary = (values > 0.5).float()
    torch.testing.assert_close(noisy_or(logits, binary), noisy_or(logits, binary * (1 - 1e-7)), atol=1e-4, rtol=1e-4)
    # in a network, other values count as fractions of a pixel
    powers = (1 - logits.sigmoid())[..., None] ** values[:, None]
    torch.testing.assert_close(binary_or(closing(logits), values), 1 - powers.prod(2), atol=1e-5, rtol=1e-4)


@torch.no_grad()
def test_with_one_gate_per_pixel_the_pooled_map_is_the_projection():
    """Gates are open at the depth of each pixel: P^-1 on the rays, per cell if columns are exact."""
    batch = views(4, SMOKE.camera)
    net, camera = network("f"), SMOKE.camera
    row = camera.bev_px - 1 - (batch["depth"][:, 0] / camera.cell_m).floor().long()  # B H W
    reached = row.permute(0, 2, 1)[:, :, None] == torch.arange(camera.bev_px)[:, None]  # B W P H
    pooled = noisy_or(torch.where(reached, 40.0, -40.0), batch["zero"].permute(0, 3, 2, 1))
    on_map = net.resample_pixels(pooled)[0][..., 0]
    projected = inverse_project(batch["zero"], batch["depth"], camera)[:, 0]
    inside = (batch["fov"][:, 0] > 0) & net.resample_pixels.valid
    assert ((on_map > 0.5) == (projected > 0.5))[inside].float().mean() > 0.9


@pytest.mark.parametrize("row", ZERO_SHOT)
def test_bytes_are_not_taken_for_values(row):
    """Batches travel as bytes: a network that took 255 for white would give a wrong map."""
    rgb, zero, depth = inputs(1)
    with pytest.raises(InputError, match=r"rgb: expected floating point, found torch\.uint8"):
        network(row)((255 * rgb).byte(), zero, depth)
    with pytest.raises(InputError, match=r"zero: expected floating point, found torch\.bool"):
        network(row)(rgb, zero > 0.5, depth)


# --- checkpoints


@torch.no_grad()
@pytest.mark.parametrize("row", ROWS)
def test_a_checkpoint_is_self_contained(row, tmp_path):
    net, images = network(row), inputs(2)
    net.save(tmp_path / "a.safetensors")
    loaded = load_model(tmp_path / "a.safetensors")
    assert type(loaded) is type(net) and (loaded.camera, loaded.config) == (net.camera, net.config)
    assert not loaded.training
    for ours, theirs in zip(loaded(*images), net(*images)):
        assert ours is theirs is None or torch.equal(ours, theirs)
    loaded.to(memory_format=torch.channels_last).save(tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_checkpoints_of_other_classes_are_named(tmp_path):
    path = tmp_path / "weights.safetensors"
    network("b.2").save(path)
    with pytest.raises(InputError, match=r"weights.safetensors: expected a checkpoint of ZeroBEV, found one of TIM"):
        ZeroBEV.load(path)
    described = json.dumps({"class": "Other", "camera": {}, "model": {}})
    save_file(load_file(path), path, metadata={"zerobev": described})
    with pytest.raises(
        InputError, match=r"weights.safetensors: expected a checkpoint of VPN, TIM, .*found one of Other"
    ):
        load_model(path)


@torch.no_grad()
@pytest.mark.parametrize("row", ["d", "f.r"])
def test_a_residual_network_may_start_from_another_network(row, tmp_path):
    """All parts that both networks have are taken; without its embedding (d) is then (c)."""
    start, net, (rgb, zero, depth) = network("c"), network(row), inputs(2, 3)
    start.save(tmp_path / "c.safetensors")
    net.load_common(tmp_path / "c.safetensors")
    for part in ("backbone", "decoder"):
        ours, theirs = (model.get_submodule(part).state_dict() for model in (net, start))
        assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    for parameter in net.embedding.parameters():
        parameter.zero_()
    same = torch.equal(net(rgb, zero, depth).zero_logits, start(rgb, zero, depth).zero_logits)
    assert same == (row == "d")


def test_a_start_without_a_common_weight_is_named(tmp_path):
    path, net = tmp_path / "other.safetensors", network("d")
    described = json.dumps({"class": "Other", "camera": {}, "model": {}})
    save_file({"other": torch.zeros(1)}, path, metadata={"zerobev": described})
    with pytest.raises(InputError, match=r"other.safetensors: expected weights of ZeroBEV, found none of its names"):
        net.load_common(path)


# --- learning


@pytest.mark.slow
@pytest.mark.parametrize("row", ["b.1", "b.2", "b.3", "c", "d", "e", "f"])
def test_eight_views_are_learnt_exactly(row):
    """Far below the loss of ones everywhere, the best prediction without the view."""
    batch = views(8, SMOKE.camera)
    if row[0] == "b":
        batch |= {"zero": batch["classes"], "target": batch["class_maps"]}
    trivial = float(dice_loss(torch.ones_like(batch["target"]), batch["target"], batch["fov"]))
    net = network(row).train()
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-2, fused=True)
    for _ in range(50):
        losses = zero_bev_loss(net(batch["rgb"], batch["zero"], batch["depth"]), batch, 0.5, net.config.aux)
        optimizer.zero_grad()
        losses.total.backward()
        optimizer.step()
    assert losses.main < 0.6 * trivial
