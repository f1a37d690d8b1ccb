import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from panolog.workers.metrics import Lpips, load_lpips, measure, sphere_weights
from tests.on_device import OnDevice, moved

H, W = 32, 64


def image(seed: int = 0) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(40, 200, (H, W, 3), np.uint8)


def test_equal_images() -> None:
    names = [prefix + name for prefix in ("", "ws_", "cc_", "cc_ws_") for name in ("psnr", "ssim")]
    expected = {name: pytest.approx(100 if "psnr" in name else 1) for name in names}
    assert measure(image(), image()) == expected | dict.fromkeys(("lpips", "lpips_3dgs", "cc_lpips"))


def test_a_photograph_with_another_exposure_is_the_same_after_the_fit() -> None:
    render = image() // 2 + 40
    truth = np.rint(render * np.array([1.2, 1.0, 0.8]) + 10).astype(np.uint8)
    metrics = measure(render, truth)
    assert metrics["psnr"] is not None and metrics["psnr"] < 25
    assert metrics["cc_psnr"] is not None and metrics["cc_psnr"] > 50


def test_the_fit_is_of_pixels_that_count_and_are_not_clipped() -> None:
    render = image() // 2 + 40
    truth = render.copy()
    mask = np.ones(render.shape[:2], bool)
    mask[:, :8] = False
    truth[:, :8] = 255 - truth[:, :8]
    truth[:, 8:16] = 255
    found = measure(render, truth, mask)
    again = measure(render, np.where(truth == 255, 254, truth).astype(np.uint8), mask)
    assert found["cc_psnr"] == found["psnr"] and again["cc_psnr"] != again["psnr"]


def test_ws_psnr_weighs_rows_by_their_area() -> None:
    render = image()
    render[0] += 50  # at the pole, almost nothing on the sphere
    metrics = measure(render, image())
    weights = sphere_weights(H)
    assert metrics["ws_psnr"] == pytest.approx(-10 * np.log10(weights[0] / weights.sum() * (50 / 255) ** 2))
    assert metrics["psnr"] == pytest.approx(-10 * np.log10((50 / 255) ** 2 / H))


def test_sphere_weights_are_areas() -> None:
    latitude = np.linspace(np.pi / 2, -np.pi / 2, H + 1)
    areas = np.sin(latitude[:-1]) - np.sin(latitude[1:])
    np.testing.assert_allclose(sphere_weights(H) / sphere_weights(H).sum(), areas / areas.sum(), rtol=1e-12)


def test_masked_pixels_take_no_part() -> None:
    truth, mask = image(), np.ones((H, W), bool)
    mask[20:, 10:30] = False
    render = truth + np.uint8(3)
    other = render.copy()
    other[~mask] = 255 - truth[~mask]
    assert measure(render, truth, mask) == measure(other, truth, mask)
    assert measure(other, truth, mask)["psnr"] == pytest.approx(20 * np.log10(255 / 3))
    assert measure(truth, truth, mask)["ssim"] == pytest.approx(1.0)


def test_the_cropped_bottom_takes_no_part() -> None:
    truth = image()
    render = truth + np.uint8(3)
    other = render.copy()
    other[-3:] = 0  # a tenth of 32 rows
    assert measure(render, truth, crop_bottom=0.1) == measure(other, truth, crop_bottom=0.1)
    assert measure(render, truth, crop_bottom=0.999) == measure(other, truth, crop_bottom=0.999)  # a row
    assert measure(render, truth) != measure(other, truth)


def test_nothing_to_compare_is_none_not_nan() -> None:
    metrics = measure(image(), image(), np.zeros((H, W), bool))
    assert set(metrics.values()) == {None}


def test_a_crop_outside_of_its_range_and_other_sizes_are_refused() -> None:
    for crop in (-0.1, 1.0):
        with pytest.raises(ValueError, match="cropped"):
            measure(image(), image(), crop_bottom=crop)
    with pytest.raises(ValueError, match="one size"):
        measure(image(), image()[:16])


def test_lpips_says_why_it_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert load_lpips("cpu") == (None, "LPIPS needs the package lpips: pip install lpips")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: object())
    monkeypatch.setattr("torch.hub.get_dir", lambda: str(tmp_path))
    assert_missing(str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "vgg16-397923af.pth").touch()
    damaged = mock.Mock(side_effect=EOFError("Ran out of input\nand more"))
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=damaged))
    assert_missing("Ran out of input")


def assert_missing(why: str) -> None:
    network, reason = load_lpips("cpu")
    assert network is None and reason is not None and why in reason and "\n" not in reason


def test_lpips_gets_images_in_its_range() -> None:
    seen: list[torch.Tensor] = []

    def network(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        seen.extend([a, b])
        return (a - b).abs().mean().reshape(1, 1, 1, 1)

    black, white = np.zeros((H, W, 3), np.uint8), np.full((H, W, 3), 255, np.uint8)
    metrics = measure(black, white, crop_bottom=0.5, lpips=Lpips(network, torch.device("cpu")))
    assert metrics["lpips"] == pytest.approx(2.0)
    assert metrics["lpips_3dgs"] == pytest.approx(1.0)
    assert [tuple(tensor.shape) for tensor in seen] == [(1, 3, H // 2, W)] * 6
    assert [float(tensor.mean()) for tensor in seen] == [-1.0, 1.0, 0.0, 1.0, -1.0, 1.0]


# On a GPU


def test_metrics_on_a_device_are_those_of_the_cpu_and_one_copy_leaves_it() -> None:
    truth, mask = image(1), np.ones((H, W), bool)
    mask[20:, 10:30] = False
    noise = np.random.default_rng(3).integers(-9, 10, truth.shape)
    for render in (image(2), truth, (truth + noise).astype(np.uint8)):
        expected = measure(render, truth, mask, crop_bottom=0.1)
        before = OnDevice.copies
        there = [moved(torch.from_numpy(each)) for each in (render, truth, mask)]
        found = measure(*there, crop_bottom=0.1)
        assert OnDevice.copies == before + 1
        for key, value in expected.items():
            if value is not None and key.endswith("psnr"):
                assert found[key] == value, key
            else:
                assert found[key] == pytest.approx(value, abs=1e-5), key


class Vgg(torch.nn.Module):
    """LPIPS as it is built on VGG16, with few channels and random weights."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.blocks, before = torch.nn.ModuleList(), 3
        for channels, convolutions in ((4, 2), (6, 2), (8, 3), (8, 3), (8, 3)):
            layers: list[torch.nn.Module] = [torch.nn.MaxPool2d(2)] if before != 3 else []
            for _ in range(convolutions):
                layers += [torch.nn.Conv2d(before, channels, 3, padding=1), torch.nn.ReLU()]
                before = channels
            self.blocks.append(torch.nn.Sequential(*layers))
        self.lins = torch.nn.ModuleList(torch.nn.Conv2d(c, 1, 1, bias=False) for c in (4, 6, 8, 8, 8))
        for layer in self.modules():
            if isinstance(layer, torch.nn.Conv2d):  # so that the deepest features vary, too
                torch.nn.init.kaiming_normal_(layer.weight)
                layer.weight.data = layer.weight if layer.out_channels > 1 else layer.weight.abs()

    def features(self, x: torch.Tensor) -> list[torch.Tensor]:
        found = []
        for block in self.blocks:
            x = block(x)
            found.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return found

    def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        pairs = zip(self.lins, self.features(a), self.features(b), strict=True)
        return torch.stack([lin((x - y) ** 2).mean() for lin, x, y in pairs]).sum()


LARGE = [pytest.param(size, marks=pytest.mark.nightly) for size in ((250, 512), (256, 530))]


@pytest.mark.parametrize("size", [(100, 200), *LARGE])
def test_lpips_by_tiles_is_that_of_the_whole(size: tuple[int, int]) -> None:
    """In double precision, where nothing hides a tile that sees too little."""
    lpips = Lpips(Vgg().eval().double(), torch.device("cpu"))
    with torch.no_grad():
        a, b = (torch.rand(1, 3, *size, dtype=torch.float64) * 2 - 1 for _ in range(2))
        whole = float(lpips.network(a, b))
        for side in (64, 512):
            assert float(lpips.by_tiles(a, b, side)) == pytest.approx(whole, rel=1e-12)


def test_lpips_is_computed_by_tiles_on_a_gpu_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Lpips, "by_tiles", lambda *_: torch.tensor(7.0))
    black, white = np.zeros((H, W, 3), np.uint8), np.full((H, W, 3), 255, np.uint8)
    with torch.no_grad():
        assert Lpips(lambda *_: torch.tensor(3.0), torch.device("cpu"))(black, white) == 3
        assert Lpips(lambda *_: torch.tensor(3.0), torch.device("meta"))(black, white) == 7
