"""Local worker processes that are lost."""

import os
import signal
import time

import pytest
from synthgen.run import cluster


@pytest.mark.slow
def test_a_worker_that_the_cluster_drops_is_started_again(monkeypatch):
    # As on a machine so busy that a worker needs longer to start again than dask waits for it.
    monkeypatch.setitem(cluster.SETTINGS, "distributed.deploy.lost-worker-timeout", "1ms")
    with cluster.connect(1, None) as client:
        before = client.run(os.getpid)
        os.kill(next(iter(before.values())), signal.SIGKILL)
        dropped, suspected, after = False, set(), {}
        while not after:  # the address of a dropped worker answers with an error for a while: ignored
            dropped = dropped or not client.cluster.workers
            time.sleep(0.1)
            if dropped:
                suspected = cluster.revive(client.cluster, suspected)
                after = client.run(os.getpid, on_error="ignore")
        assert not {*after.values()} & {*before.values()}
