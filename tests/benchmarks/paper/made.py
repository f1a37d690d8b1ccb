"""Results made by hand."""

from benchmarks.paper.results import Point, Result


def result(variant: str, ws_psnr: float, *, scene: str = "street", seed: int = 0, **more: object) -> Result:
    """A run of 100 s: 40 of Stage I, 10 of scoring, 50 of blocks, the longest of which took 30."""
    metrics = {"psnr": ws_psnr - 1, "ssim": 0.8, "lpips": None, "ws_psnr": ws_psnr, "ws_ssim": 0.81}
    given = {
        "iterations": 600,
        "blocks": 2,
        "metrics": metrics,
        "gaussians": 20_000,
        "bytes": 5_000_000,
        "seconds": {"coarse": 40.0, "score": 10.0, "block": 50.0, "eval": 7.0},
        "longest": 30.0,
        "threads": 1,
        "memory": 10**9,
        "curve": (Point(20.0, ws_psnr - 4, "coarse"), Point(100.0, ws_psnr, "merged")),
    }
    return Result(scene, variant, seed, **{**given, **more})  # type: ignore[arg-type]
