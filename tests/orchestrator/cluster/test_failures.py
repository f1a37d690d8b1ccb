"""What Ray itself raises becomes one clear line."""

import pytest
from ray.exceptions import RaySystemError

from panolog.orchestrator.cluster.failures import reported
from panolog.scene.errors import ClusterLostError


def test_a_failure_of_ray_is_a_lost_cluster() -> None:
    @reported
    def fails() -> None:
        raise RaySystemError("Ray has not been started yet.")  # type: ignore[no-untyped-call]

    with pytest.raises(ClusterLostError, match=r"^Ray: System error: Ray has not been started yet\.$"):
        fails()
