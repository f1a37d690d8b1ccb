"""What stands between the ops and a card: messages without one, training, streams and refusals on one."""

from dataclasses import replace

import pytest
import torch

from panolog.renderer.cuda import nvrtc
from panolog.renderer.render import render
from panolog.scene.errors import InputError
from tests.on_device import needs_a_card
from tests.renderer.agreement import NEAR
from tests.renderer.hard_scenes import camera, cloud

pytest.importorskip("cuda.core", reason="CUDA: no cuda-core")
from cuda.bindings import driver

from panolog.renderer.cuda import card


def test_a_card_that_is_too_old() -> None:
    assert card.architecture("RTX 4090", (8, 9)) == "sm_89"
    with pytest.raises(InputError, match=r"Quadro P400 has compute capability 6\.1, 7\.5 is needed"):
        card.architecture("Quadro P400", (6, 1))


def test_a_driver_that_is_too_old(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nvrtc, "nvrtc_version", lambda: (13, 0, ("sm_89",)))
    monkeypatch.setattr(driver, "cuDriverGetVersion", lambda: (0, 13020))
    card.check_driver()
    monkeypatch.setattr(driver, "cuDriverGetVersion", lambda: (0, 12080))
    with pytest.raises(InputError, match=r"driver is of CUDA 12\.8, .* update the driver"):
        card.check_driver()


@needs_a_card
def test_kernels_follow_torchs_current_stream() -> None:
    scene, at = cloud(3000).to("cuda"), camera(512).to("cuda")
    expected = render(scene, at, near=NEAR).color
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        found = [render(scene, at, near=NEAR).color for _ in range(5)]
    stream.synchronize()
    for image in found:
        assert torch.equal(image, expected)


@needs_a_card
def test_a_tensor_that_was_left_on_the_cpu_is_refused() -> None:
    with pytest.raises(ValueError, match="sh0 is a tensor on cpu"):
        scene = cloud(20).to("cuda")
        render(replace(scene, sh0=scene.sh0.cpu()), camera())
