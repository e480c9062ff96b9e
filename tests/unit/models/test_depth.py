"""Depth in metres: training pairs, errors in closed form, our network, and models of the transformers library."""

import json
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from transformers import (
    BeitConfig,
    BitConfig,
    DepthAnythingConfig,
    DepthAnythingForDepthEstimation,
    DepthProConfig,
    DepthProForDepthEstimation,
    Dinov2Config,
    DPTConfig,
    DPTForDepthEstimation,
    GLPNConfig,
    GLPNForDepthEstimation,
    PreTrainedModel,
    PromptDepthAnythingConfig,
    PromptDepthAnythingForDepthEstimation,
    ZoeDepthConfig,
    ZoeDepthForDepthEstimation,
)

from zerobev.common.errors import InputError
from zerobev.config import SCALES, TrainConfig
from zerobev.data.samples import as_float
from zerobev.data.view_set import ViewSet
from zerobev.data.views import View
from zerobev.geometry.cameras import Camera
from zerobev.inference import Projector
from zerobev.inference.pinhole import PinholeView
from zerobev.models.backbone import IMAGENET_MEAN, IMAGENET_STD, RgbEncoder
from zerobev.models.backbone_weights import load_backbone
from zerobev.models.depth import FARTHEST_M, DepthNet, HubDepth
from zerobev.training.depth import (
    DepthErrors,
    DepthSamples,
    depth_errors,
    depth_objective,
    predict_depth,
    relative_depth_objective,
    train_depth,
)

SMOKE = SCALES["smoke"]


@pytest.fixture(autouse=True)
def seeded():
    torch.set_num_threads(1)
    torch.manual_seed(0)


class Recorded:
    """A shard of given photographs and depth maps."""

    def __init__(self, rgb: np.ndarray, depth: np.ndarray):
        self.rgb, self.depth = rgb, depth

    def __len__(self) -> int:
        return len(self.rgb)

    def view(self, index: int) -> View:
        parts = dict.fromkeys((field.name for field in fields(View)), np.zeros(0))
        return View(**parts | {"rgb": self.rgb[index], "depth": self.depth[index]})


def recorded(*counts: int, side: int = 32) -> ViewSet:
    """Images of random grey levels, brighter to the right; depth is red / 64 metres."""
    rng = np.random.default_rng(0)
    shards = []
    for count in counts:
        level = rng.integers(40, 160, (count, 1, 1)) + np.linspace(0, 80, side).astype(int) + np.zeros((side, 1), int)
        rgb = np.stack([level, level // 2, level // 3], axis=-1).astype(np.uint8)
        shards.append(Recorded(rgb, (rgb[..., 0] / 64).astype(np.float32)))
    return ViewSet(shards)


class Red(nn.Module):
    """The estimator that inverts `recorded`, up to a factor; it records its inputs."""

    def __init__(self, factor: float = 1.0):
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(factor))
        self.noise = nn.Dropout(0.5)

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        return self.noise(rgb[:, :1] * 255 / 64 * self.factor)


# --- samples ------------------------------------------------------------------------------------------------------


def test_half_of_the_pairs_are_mirrored():
    batch = as_float(DepthSamples(recorded(30, 34), seed=0, batch=64).batch(0))
    torch.testing.assert_close(batch["depth"], batch["rgb"][:, :1] * 255 / 64)
    mirrored = batch["depth"][..., 0] > batch["depth"][..., -1]
    assert 20 < int(mirrored[:, 0, 0].sum()) < 44


def test_every_pass_has_every_view_once_in_another_order():
    views = recorded(5, 3)
    levels = sorted(float(views.locate(i)[1].depth.mean()) for i in range(8))
    passes = [DepthSamples(views, seed=1, batch=8).batch(step)["depth"].mean(dim=(1, 2, 3)) for step in (0, 1)]
    assert not torch.equal(*passes)
    for shown in passes:
        np.testing.assert_allclose(np.sort(shown), levels, rtol=1e-6)


def test_processes_divide_a_batch():
    data = DepthSamples(recorded(9), seed=3, batch=6)
    whole, parts = data.batch(2), [data.batch(2, rank, 2) for rank in (0, 1)]
    for name, tensor in whole.items():
        assert torch.equal(tensor[::2], parts[0][name]) and torch.equal(tensor[1::2], parts[1][name])


# --- objective, errors, prediction --------------------------------------------------------------------------------


def test_the_objective_is_the_mean_absolute_difference_over_known_depth():
    predicted = torch.tensor([1.0, 5.0, 9.0, 2.0], requires_grad=True)
    batch = {"rgb": torch.zeros(1), "depth": torch.tensor([2.0, 2.0, 0.0, 0.0])}
    losses = depth_objective(lambda rgb: predicted, batch)
    losses.total.backward()
    assert float(losses.total.detach()) == float(losses.main.detach()) == 2.0
    assert predicted.grad.tolist() == [-0.5, 0.5, 0.0, 0.0]
    nothing = depth_objective(lambda rgb: predicted, batch | {"depth": torch.zeros(4)})
    assert float(nothing.total.detach()) == 0


def test_the_relative_objective_divides_by_true_depth():
    predicted = torch.tensor([3.0, 1.0, 9.0], requires_grad=True)
    batch = {"rgb": torch.zeros(1), "depth": torch.tensor([4.0, 0.2, 0.0])}
    losses = relative_depth_objective(lambda rgb: predicted, batch)
    losses.total.backward()
    assert float(losses.total.detach()) == pytest.approx((1 / 4 + 0.8 / 0.5) / 2)  # as if it were half a metre away
    np.testing.assert_allclose(predicted.grad, [-1 / 8, 1.0, 0.0])


def test_own_rays_tell_heights_apart():
    """With own rays the height changes the depth; without, and at the camera's own height, it does not."""
    rgb = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    scale = SCALES["smoke"]
    for own_rays in (False, True):
        torch.manual_seed(0)
        network = DepthNet(scale.camera, replace(scale.model, own_rays=own_rays)).eval()
        with torch.inference_mode():
            plain, same, other = (network(rgb, h) for h in (None, torch.full((2,), 0.88), torch.tensor([0.88, 1.6])))
        torch.testing.assert_close(plain, same)
        torch.testing.assert_close(plain[0], other[0])
        assert torch.allclose(plain[1], other[1]) != own_rays


def test_errors_in_closed_form():
    views = recorded(40, 3)
    for shard in views.shards:
        shard.depth[:, :7] = 0  # unknown
    known = np.concatenate([shard.depth[shard.depth > 0] for shard in views.shards]).astype(np.float64)
    errors = depth_errors(Red(1.25), views)
    assert isinstance(errors, DepthErrors)
    assert errors.mad_m == pytest.approx(0.25 * known.mean(), rel=1e-3)
    assert errors.relative == pytest.approx(0.25, rel=1e-3)


def test_prediction_replaces_the_depth_of_every_view():
    views = recorded(2, 35, 1)
    maps = predict_depth(Red(2.0), views)
    assert [(a.shape, a.dtype) for a in maps] == [((n, 32, 32), np.float16) for n in (2, 35, 1)]
    predicted = views.with_depth(maps)
    for i in (0, 1, 2, 36, 37):
        np.testing.assert_allclose(predicted.locate(i)[1].depth, 2 * views.locate(i)[1].depth, rtol=1e-3)


def test_training_learns_and_returns_the_best_validated_weights(tmp_path):
    config = TrainConfig(steps=40, learning_rate=1e-2, decay_every=10, decay=0.5, validate_every=20, warmup=5, batch=8)
    network = DepthNet(SMOKE.camera, SMOKE.model)
    validation = recorded(12)
    truth = np.concatenate([validation.locate(i)[1].depth for i in range(12)])
    constant = np.abs(truth - np.median(truth)).mean()  # the best prediction without the image
    history = train_depth(network, recorded(24), validation, config, tmp_path, 0, key="toy", device="cpu")
    error = depth_errors(network, validation).mad_m
    assert error < 0.5 * constant
    assert error == pytest.approx(history.best_score, rel=0.1)  # the score may be in bfloat16


def test_a_resumed_run_has_the_same_weights(tmp_path):
    def trained(folder: str, *steps: int) -> dict[str, torch.Tensor]:
        for until in steps:
            torch.manual_seed(1)
            network = DepthNet(SMOKE.camera, SMOKE.model)
            config = TrainConfig(steps=until, learning_rate=1e-2, decay_every=3, validate_every=2, batch=4)
            train_depth(network, recorded(6), recorded(2), config, tmp_path / folder, 0, key="toy", device="cpu")
        return network.state_dict()

    whole, parts = trained("whole", 4), trained("parts", 2, 4)
    assert all(torch.equal(tensor, parts[name]) for name, tensor in whole.items())


# --- our network --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [32, 45])
@pytest.mark.parametrize("stem", [2, 4])
def test_depth_has_the_size_of_the_image_and_each_pixel_its_own(side, stem):
    network = DepthNet(replace(SMOKE.camera, fpv_px=side), replace(SMOKE.model, stem_stride=stem)).eval()
    rgb = torch.rand(2, 3, side, side, requires_grad=True)
    depth = network(rgb)
    assert depth.shape == (2, 1, side, side) and depth.dtype == torch.float32
    assert ((depth > 0) & (depth <= FARTHEST_M)).all()
    for pixel in ((0, 0), (side // 2, side // 3), (side - 1, side - 1)):
        (gradient,) = torch.autograd.grad(depth[0, 0][pixel], rgb, retain_graph=True)
        assert gradient[0, :, pixel[0], pixel[1]].abs().sum() > 0
        assert gradient[1].abs().sum() == 0


def test_the_network_has_the_rays_as_input():
    wide, narrow = (DepthNet(replace(SMOKE.camera, hfov_deg=hfov), SMOKE.model).eval() for hfov in (79, 50))
    narrow.load_state_dict(wide.state_dict())
    rgb = torch.rand(1, 3, 32, 32)
    assert (wide(rgb) - narrow(rgb)).abs().max() > 1e-3
    np.testing.assert_allclose(narrow.rays[0, 0, 0, -1], np.tan(np.radians(25)) * 31 / 32, rtol=1e-5)
    np.testing.assert_allclose(narrow.rays[0, 1, 0, 0], -np.tan(np.radians(25)) * 31 / 32, rtol=1e-5)


def test_an_image_of_another_size_is_refused():
    with pytest.raises(InputError, match=r"rgb: expected \(1, 3, 32, 32\), found \(1, 3, 48, 48\)"):
        DepthNet(SMOKE.camera, SMOKE.model)(torch.rand(1, 3, 48, 48))


def test_a_checkpoint_restores_the_network_and_pretrains_a_backbone(tmp_path):
    network = DepthNet(SMOKE.camera, SMOKE.model)
    network(torch.rand(4, 3, 32, 32))  # changes the statistics of the batch norms
    network.save(tmp_path / "depth.safetensors")
    again = DepthNet.load(tmp_path / "depth.safetensors")
    rgb = torch.rand(2, 3, 32, 32)
    assert torch.equal(again(rgb), network.eval()(rgb))
    backbone = RgbEncoder(SMOKE.model).eval()
    load_backbone(backbone, tmp_path / "depth.safetensors")
    for ours, theirs in zip(backbone(rgb), network.backbone(rgb), strict=True):
        torch.testing.assert_close(ours, theirs)


# --- models of the transformers library ---------------------------------------------------------------------------


def depth_anything(kind: str = "metric") -> DepthAnythingForDepthEstimation:
    backbone = Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=42,
        patch_size=14,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
        apply_layernorm=True,
    )
    sizes = {"neck_hidden_sizes": [8, 8, 16, 16], "fusion_hidden_size": 8, "head_hidden_size": 8}
    return DepthAnythingForDepthEstimation(
        DepthAnythingConfig(
            backbone_config=backbone, reassemble_hidden_size=16, depth_estimation_type=kind, max_depth=20, **sizes
        )
    )


def dpt(**changes) -> DPTForDepthEstimation:
    config = {
        "hidden_size": 16,
        "num_hidden_layers": 4,
        "num_attention_heads": 2,
        "intermediate_size": 32,
        "image_size": 64,
        "patch_size": 16,
        "backbone_out_indices": [0, 1, 2, 3],
        "neck_hidden_sizes": [8, 8, 16, 16],
        "fusion_hidden_size": 8,
    }
    return DPTForDepthEstimation(DPTConfig(**config | changes))


def dpt_hybrid() -> DPTForDepthEstimation:
    backbone = BitConfig(
        global_padding="same",
        layer_type="bottleneck",
        depths=[1, 1, 1],
        hidden_sizes=[16, 32, 64],
        embedding_size=16,
        num_groups=4,
        out_features=["stage1", "stage2", "stage3"],
        embedding_dynamic_padding=True,
    )
    return dpt(
        is_hybrid=True,
        backbone_config=backbone,
        backbone_featmap_shape=[1, 64, 4, 4],
        neck_hidden_sizes=[16, 32, 16, 16],
    )


def glpn() -> GLPNForDepthEstimation:
    sizes = {"hidden_sizes": [8, 8, 16, 16], "depths": [1] * 4, "num_attention_heads": [1] * 4}
    return GLPNForDepthEstimation(GLPNConfig(**sizes, decoder_hidden_size=8, max_depth=10))


def zoedepth() -> ZoeDepthForDepthEstimation:
    backbone = BeitConfig(
        image_size=64,
        patch_size=16,
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=32,
        out_features=["stage1", "stage2", "stage3", "stage4"],
        reshape_hidden_states=False,
        use_relative_position_bias=True,
    )
    return ZoeDepthForDepthEstimation(
        ZoeDepthConfig(
            backbone_config=backbone,
            neck_hidden_sizes=[8, 8, 16, 16],
            fusion_hidden_size=16,
            bottleneck_features=16,
            num_relative_features=8,
            bin_embedding_dim=8,
            num_attractors=[2, 2, 2, 1],
            bin_configurations=[{"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0}],
        )
    )


def depth_pro() -> DepthProForDepthEstimation:
    tiny = {"model_type": "dinov2", "image_size": 32, "patch_size": 16, "hidden_size": 16, "num_hidden_layers": 2}
    tiny |= {"num_attention_heads": 2, "mlp_ratio": 2}
    models = {f"{name}_model_config": dict(tiny) for name in ("image", "patch", "fov")}
    sizes = {"intermediate_hook_ids": [1, 0], "intermediate_feature_dims": [8, 8], "fusion_hidden_size": 8}
    config = DepthProConfig(
        patch_size=32, scaled_images_feature_dims=[8, 8, 8], num_fov_head_layers=1, **sizes, **models
    )
    return DepthProForDepthEstimation(config)


def prompt_depth_anything() -> PromptDepthAnythingForDepthEstimation:
    given = depth_anything().config
    sizes = {"neck_hidden_sizes": [8, 8, 16, 16], "fusion_hidden_size": 8, "head_hidden_size": 8}
    config = PromptDepthAnythingConfig(
        backbone_config=given.backbone_config, reassemble_hidden_size=16, depth_estimation_type="metric", **sizes
    )
    return PromptDepthAnythingForDepthEstimation(config)


def loaded(network: PreTrainedModel, folder: Path) -> HubDepth:
    """The network after a round trip through a folder; a DPT with `predicts_metres`."""
    network.save_pretrained(folder)
    return HubDepth.from_pretrained(folder, predicts_metres=network.config.model_type == "dpt")


def seen_by(estimator: HubDepth) -> list[torch.Tensor]:
    """Inputs of the inner network, per call."""
    seen: list[torch.Tensor] = []
    estimator.network.register_forward_pre_hook(
        lambda module, args, kwargs: seen.append(kwargs["pixel_values"]), with_kwargs=True
    )
    return seen


@pytest.mark.parametrize(
    ("make", "side", "inner"),
    [
        (depth_anything, 32, 42),
        (depth_anything, 42, 42),
        (depth_anything, 300, 42),
        (dpt, 64, 64),
        (dpt, 32, 64),
        (dpt_hybrid, 48, 64),
        (glpn, 64, 480),
        (zoedepth, 48, 64),
    ],
)
def test_a_folder_gives_an_estimator_for_any_image_size(make, side, inner, tmp_path):
    network = make().eval()
    estimator = loaded(network, tmp_path)
    assert estimator.side_px == inner
    seen = seen_by(estimator)
    rgb = torch.rand(2, 3, side, side)
    with torch.no_grad():
        depth = estimator(rgb)
        alone = estimator(rgb[1:])
        direct = network(pixel_values=seen[0]).predicted_depth
    assert depth.shape == (2, 1, side, side) and seen[0].shape == (2, 3, inner, inner)
    torch.testing.assert_close(depth[1:], alone, rtol=1e-4, atol=1e-5)
    assert depth.mean() == pytest.approx(float(direct.mean()), rel=0.05)
    if direct.shape[-2:] == (side, side):
        torch.testing.assert_close(depth[:, 0], direct)


@pytest.mark.parametrize(("make", "farthest_m"), [(depth_anything, 20), (glpn, 10), (zoedepth, 10)])
def test_metric_types_predict_metres_up_to_the_maximum_of_their_configuration(make, farthest_m):
    estimator = HubDepth(make()).eval()
    with torch.no_grad():
        depth = estimator(torch.rand(1, 3, 64, 64))
    assert depth.min() > 0 and depth.max() <= farthest_m


def test_depth_is_at_most_that_of_the_floor():
    """With `floor_depth`, rows below the horizon end at the floor, whatever the weights; rows above are free."""
    model = replace(SMOKE.model, floor_depth=True)
    network = DepthNet(SMOKE.camera, model).eval()
    side, camera = SMOKE.camera.fpv_px, SMOKE.camera
    slope = (np.arange(side) + 0.5 - side / 2) / camera.focal_px
    floor = np.minimum(camera.height_m / np.maximum(slope, 1e-9), FARTHEST_M)
    with torch.no_grad():
        for bias in (-30.0, 0.0, 5.0):
            network.head.bias.fill_(bias)
            depth = network(torch.rand(1, 3, side, side))[0, 0].numpy()
            assert (depth <= floor[:, None] * (1 + 1e-5)).all()
            if bias == -30.0:
                np.testing.assert_allclose(depth, np.repeat(floor[:, None], side, axis=1), rtol=1e-4)
        assert (DepthNet(SMOKE.camera, SMOKE.model).least == 1 / FARTHEST_M).all()


def test_a_projector_resamples_the_photograph_to_the_size_of_the_model():
    estimator = HubDepth(depth_anything())
    seen = seen_by(estimator)
    fine = replace(SMOKE.camera, fpv_px=42)
    photograph = np.random.default_rng(0).random((500, 500, 3))
    depth = Projector("a.2", SMOKE.camera, None, estimator.eval()).depth(photograph)
    assert depth.shape == (32, 32)
    expected = torch.from_numpy(PinholeView((500, 500), Camera(), fine).photograph(photograph)).permute(2, 0, 1)
    torch.testing.assert_close(seen[0][0] * estimator.std + estimator.mean, expected)


@pytest.mark.parametrize("own", [None, ((0.5, 0.4, 0.3), (0.25, 0.5, 1.0))])
def test_images_are_normalised_as_in_the_image_processor(own, tmp_path):
    if own:
        settings = {"image_processor_type": "DPTImageProcessor", "image_mean": own[0], "image_std": own[1]}
        (tmp_path / "preprocessor_config.json").write_text(json.dumps(settings))
    estimator = loaded(dpt(), tmp_path)
    seen = seen_by(estimator)
    rgb = torch.rand(1, 3, 64, 64)
    estimator(rgb)
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in own or (IMAGENET_MEAN, IMAGENET_STD))
    torch.testing.assert_close(seen[0], (rgb - mean) / std)


@pytest.mark.parametrize(("make", "mean", "std"), [(glpn, 0, 1), (zoedepth, 0.5, 0.5)])
@pytest.mark.parametrize("settings", [None, {"do_normalize": False}])
def test_without_settings_images_are_normalised_as_in_training(make, mean, std, settings, tmp_path):
    if settings:
        (tmp_path / "preprocessor_config.json").write_text(json.dumps(settings))
        mean, std = 0, 1
    estimator = loaded(make(), tmp_path)
    assert estimator.mean.unique().tolist() == [mean] and estimator.std.unique().tolist() == [std]


@pytest.mark.parametrize("make", [depth_anything, dpt, dpt_hybrid])
def test_fine_tuning_lowers_the_error(make, tmp_path):
    estimator = HubDepth(make())
    views = recorded(8)
    before = depth_errors(estimator, views).mad_m
    config = TrainConfig(steps=6, learning_rate=3e-3, decay_every=100, validate_every=3, batch=4)
    train_depth(estimator, views, views, config, tmp_path, 0, key="tiny", device="cpu")
    assert depth_errors(estimator, views).mad_m < before


def test_relative_depth_is_refused(tmp_path):
    depth_anything("relative").save_pretrained(tmp_path)
    message = f"{tmp_path}: expected a model of metric depth, found one of relative depth"
    with pytest.raises(InputError, match=re.escape(message)):
        HubDepth.from_pretrained(tmp_path)
    dpt().save_pretrained(tmp_path)
    with pytest.raises(InputError, match="found a DPT, relative as published: pass predicts_metres=True"):
        HubDepth.from_pretrained(tmp_path)


@pytest.mark.parametrize(
    ("make", "kind", "predicts"),
    [
        (depth_pro, "depth_pro", "inverse depth"),
        (prompt_depth_anything, "prompt_depth_anything", "depth that is completed"),
    ],
)
def test_types_that_do_not_predict_metres_are_refused_before_their_weights_are_read(make, kind, predicts, tmp_path):
    network = make()
    network.config.save_pretrained(tmp_path)
    message = rf"\(depth_anything, dpt, glpn, zoedepth\), found {kind}, which predicts {predicts}"
    with pytest.raises(InputError, match=re.escape(str(tmp_path)) + ": expected a model of metric depth " + message):
        HubDepth.from_pretrained(tmp_path, predicts_metres=True)
    with pytest.raises(InputError, match="network: expected a model of metric depth " + message):
        HubDepth(network)


def test_a_folder_without_a_weight_or_a_model_is_refused(tmp_path):
    with pytest.raises(InputError, match=re.escape(str(tmp_path / "nothing"))):
        HubDepth.from_pretrained(tmp_path / "nothing")
    network = dpt()
    lost = "head.head.0.weight"
    network.save_pretrained(tmp_path, state_dict={k: v for k, v in network.state_dict().items() if k != lost})
    with pytest.raises(InputError, match=rf"{re.escape(str(tmp_path))}: .*{re.escape(lost)}"):
        HubDepth.from_pretrained(tmp_path, predicts_metres=True)
