"""A fleet whose recordings lie in a bucket, or whose workers are a cluster: moto's server, and a real one of Dask."""

import importlib.util
import logging
import os
import socket

import pytest
from buckets import BUCKETS, served
from commands import refused
from commands import run as command
from test_fleet import BY_FOLDER, TOUCHES, expected, memory_of, run, touch_files
from touches import PAD, SETTINGS

from scroll_tactile import TactileLearner
from scroll_tactile.clients.learning.fleet import learn

CLUSTER = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="dask[distributed] is missing")


@pytest.fixture(scope="module")
def bucket():
    """An empty bucket: its address begins here."""
    with served("touches") as files:
        yield files


@BUCKETS
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
class TestBucket:
    def test_recordings_and_packed_memories_in_a_bucket_are_one_memory(self, tmp_path, bucket):
        for path in touch_files(tmp_path / "in", TOUCHES[:9]):
            bucket.put_file(str(path), f"touches/day/{path.parent.name}/{path.name}")
        memory_of(tmp_path / "robot", TOUCHES[7:], tmp_path / "robot.part", source="robot 7")
        bucket.put_file(str(tmp_path / "robot.part"), "touches/robot.part")
        done = run(tmp_path / "m", ["s3://touches/day", "s3://touches/robot.part", "s3://touches/nothing"])
        assert [each.source for each in done.refused] == ["s3://touches/nothing"]
        assert done.observations == 12 and done.repeated == 2
        assert done.digest == expected().digest()
        with TactileLearner.open(tmp_path / "m") as learner:
            assert learner.forget(source="s3://touches/day") + learner.forget(source="robot 7") == 12

    def test_a_bucket_that_denies_or_is_not_there_is_listed(self, tmp_path, bucket, monkeypatch):
        touch_files(tmp_path / "in", TOUCHES)
        import s3fs

        def denied(*_, **__):
            raise PermissionError("Access Denied")

        monkeypatch.setattr(s3fs.S3FileSystem, "isdir", denied)
        done = run(tmp_path / "m", [tmp_path / "in", "s3://secret/day", "nosuch://bucket/day"])
        assert {each.source for each in done.refused} == {"s3://secret/day", "nosuch://bucket/day"}
        assert "Access Denied" in "".join(each.why for each in done.refused)
        assert done.digest == expected().digest()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_memory_elsewhere_is_fetched_and_one_that_is_damaged_or_never_comes_is_named(tmp_path, monkeypatch, workers):
    from fsspec.implementations.memory import MemoryFileSystem

    files = MemoryFileSystem()
    memory_of(tmp_path / "robot", TOUCHES, tmp_path / "p")
    whole = (tmp_path / "p").read_bytes()
    spoilt = bytearray(whole)
    spoilt[3000] ^= 1  # in the log
    files.pipe({"/day/sound.part": whole, "/day/spoilt.part": bytes(spoilt), "/day/gone.part": whole})
    fetch = MemoryFileSystem.get_file

    def fetching(self, address, *words, **named):
        if "gone" in address:
            raise PermissionError("Access Denied")
        return fetch(self, address, *words, **named)

    monkeypatch.setattr(MemoryFileSystem, "get_file", fetching)
    addresses = [f"memory://day/{name}.part" for name in ("spoilt", "gone", "sound")]
    try:
        done = learn(addresses, tmp_path / "m", BY_FOLDER, workers=workers, **SETTINGS)
    finally:
        files.rm("/day", recursive=True)
    assert [each.source for each in done.refused] == addresses[:2]
    assert "Access Denied" in done.refused[1].why
    assert done.digest == expected().digest()
    with TactileLearner.open(tmp_path / "m") as learner:
        assert learner.forget(source="memory://day/sound.part") == 12


@CLUSTER
@pytest.mark.filterwarnings("ignore")  # those of the cluster's libraries
class TestCluster:
    def test_a_clusters_workers_learn_the_same_bytes_also_where_one_is_lost(self, tmp_path):
        from distributed import Client, LocalCluster

        touch_files(tmp_path / "in", TOUCHES + TOUCHES[:4])
        quiet = {"dashboard_address": None, "silence_logs": logging.CRITICAL}
        with (
            LocalCluster(n_workers=2, threads_per_worker=1, processes=True, **quiet) as cluster,
            Client(cluster) as client,
        ):
            killed = []

            def kill(what, done, of):
                if not killed:
                    killed.append(client.run(os.getpid))
                    worker = next(iter(killed[0]))
                    os.kill(killed[0][worker], 9)

            how = {"executor": client.get_executor(), "workers": 2, "progress": kill}
            done = learn([tmp_path / "in"], tmp_path / "m", BY_FOLDER, **how, **SETTINGS)
            command_line = command(
                "fleet", tmp_path / "by command", tmp_path / "m", "--scheduler", cluster.scheduler_address, "--json",
                "--sensor", _described(tmp_path),
            )  # fmt: skip
        assert killed and done.observations == 12 and not done.refused
        assert done.digest == expected().digest()
        assert command_line.exit_code == 1, command_line.output  # the command's embedding is the default one
        assert "refused" in command_line.output


def _described(folder):
    path = folder / "pad.json"
    path.write_text(PAD.model_dump_json())
    return path


class TestRefused:
    @CLUSTER
    @pytest.mark.filterwarnings("ignore")
    def test_a_scheduler_that_is_not_there(self, tmp_path, monkeypatch):
        monkeypatch.setattr("scroll_tactile.clients.cli.bulk.SECONDS", 1)
        touch_files(tmp_path / "in", TOUCHES[:1])
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
        line = refused("fleet", tmp_path / "m", tmp_path / "in", "--scheduler", f"tcp://127.0.0.1:{port}")
        assert "no scheduler answers at" in line
        assert not (tmp_path / "m").exists()

    def test_a_scheduler_has_workers_of_its_own(self, tmp_path):
        line = refused("fleet", tmp_path / "m", tmp_path, "--scheduler", "tcp://x:1", "--workers", "2")
        assert "--workers or --scheduler" in line

    def test_the_command_says_what_it_did_and_ends_with_1_where_something_was_refused(self, tmp_path):
        paths = touch_files(tmp_path / "in", TOUCHES[:4])
        words = ["--sensor", _described(tmp_path), "--label-by", "folder", "--workers", "1"]
        done = command("fleet", tmp_path / "m", tmp_path / "in", *words)
        assert done.exit_code == 0, done.output
        assert "4 touches of 3 materials from 4 files; the memory has 4 now" in done.output
        with TactileLearner.open(tmp_path / "m") as learner:
            assert learner.digest() in done.output and sum(learner.materials.values()) == 4
        paths[0].with_name("bad.npy").write_bytes(b"")
        again = command("fleet", tmp_path / "m", tmp_path / "in", *words)
        assert again.exit_code == 1 and "bad.npy" in again.stderr and "0 touches from 5 files" in again.output
