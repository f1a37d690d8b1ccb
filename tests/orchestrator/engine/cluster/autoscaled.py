"""A Ray cluster whose autoscaler starts and ends nodes on this machine."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.ray_head import BIN, cluster_environment, free_ports, started, wait_until

_HEAD = f"{'f' * 51}00000"  # Node.id, by which Ray's provider of local nodes knows the head
_HEAD_TYPE = "ray.head.default"
_PROVIDER = "ray.autoscaler._private.fake_multi_node.node_provider.FakeMultiNodeProvider"
_UNUSED = (
    *("initialization_commands", "setup_commands", "head_setup_commands", "worker_setup_commands"),
    *("head_start_ray_commands", "worker_start_ray_commands"),
)


@contextmanager
def autoscaled(most: int, idle: float = 5.0) -> Iterator[tuple[str, dict[str, str]]]:
    """The address of a cluster of a head without cores, and the environment of its drivers.

    Args: most, nodes of one core that its autoscaler starts; idle, seconds after which it ends one.
    """
    (port,) = free_ports(1)
    address = f"127.0.0.1:{port}"
    variables = cluster_environment() | {"RAY_enable_autoscaler_v2": "1"}
    fake = {"RAY_FAKE_CLUSTER": "1", "AUTOSCALER_UPDATE_INTERVAL_S": "1"}
    fake |= {"RAY_CLOUD_INSTANCE_ID": _HEAD, "RAY_OVERRIDE_NODE_ID_FOR_TESTING": _HEAD}
    with TemporaryDirectory(prefix="scaled-", dir="/tmp", ignore_cleanup_errors=True) as folder:
        config, log = Path(folder, "autoscaler.json"), Path(folder, "start.log")
        config.write_text(json.dumps(_config(address, most, idle)))
        command = [str(BIN / "ray"), "start", "--head", "--block", f"--port={port}"]
        command += ["--node-ip-address=127.0.0.1", "--num-cpus=0", "--include-dashboard=false"]
        command += [f"--autoscaling-config={config}", f"--temp-dir={folder}"]
        command += ["--min-worker-port=0", "--max-worker-port=0", "--object-store-memory=100000000"]
        with started(command, variables | fake, log):
            wait_until(lambda: "Ray runtime started" in log.read_text(), "the head is up")
            yield address, variables


def _config(address: str, most: int, idle: float) -> dict[str, object]:
    provider = {"type": "external", "module": _PROVIDER, "gcs_address": address}
    node = {"resources": {"CPU": 1, "object_store_memory": 10**8}, "node_config": {}}
    return {
        **{"cluster_name": "local", "max_workers": most, "idle_timeout_minutes": idle / 60},
        "provider": provider | {"launch_multiple": True, "head_node_id": _HEAD},
        "head_node_type": _HEAD_TYPE,
        "available_node_types": {
            _HEAD_TYPE: {"resources": {"CPU": 0}, "node_config": {}, "max_workers": 0},
            "small": {**node, "min_workers": 0, "max_workers": most},
        },
        **{"auth": {}, "docker": {}, "file_mounts": {}, **{key: [] for key in _UNUSED}},
        **{"cluster_synced_files": [], "file_mounts_sync_continuously": False},
        **{"rsync_exclude": [], "rsync_filter": [], "upscaling_speed": 1.0},
    }
