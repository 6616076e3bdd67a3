"""Downloads by name: checked, whole or not at all, from a server of the test's own."""

from __future__ import annotations

import csv
import hashlib
import shutil
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from probmotion.data import downloads
from probmotion.data.downloads import DownloadError, download, salsa_pairs
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.io.files import save_motion

COMMIT = "0" * 40


class Handler(SimpleHTTPRequestHandler):
    """Serves a folder and notes what was asked for; breaks off where it is told to."""

    asked: list[str]
    broken: bool

    def do_GET(self):
        self.asked.append(self.path)
        if type(self).broken:
            self.send_response(200)
            self.send_header("Content-Length", "1000")
            self.end_headers()
            self.wfile.write(b"half of it")
            self.close_connection = True
        else:
            super().do_GET()

    def log_message(self, *_):
        pass


@pytest.fixture
def server(tmp_path):
    """A server of ``tmp_path/served``: its address as ``url``, its handler as ``handler``."""
    served = tmp_path / "served"
    served.mkdir()
    handler = type("OwnHandler", (Handler,), {"asked": [], "broken": False})
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=served)) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.01,))
        thread.start()
        running.url = f"http://127.0.0.1:{running.server_port}"
        running.handler = handler
        yield running
        running.shutdown()
        thread.join()


@pytest.fixture
def registry(server, tmp_path, monkeypatch):
    """Two made files, served and registered as data set ``made``; returns their contents."""
    contents = {"a.bvh": b"HIERARCHY", "b c.bvh": b"MOTION" * 1000}
    place = tmp_path / "served" / "some" / "where" / COMMIT / "deep"
    place.mkdir(parents=True)
    lines = ["dataset,repository,commit,path,sha256,bytes,licence"]
    for name, content in contents.items():
        (place / name).write_bytes(content)
        digest = hashlib.sha256(content).hexdigest()
        lines.append(f"made,some/where,{COMMIT},deep/{name},{digest},{len(content)},CMU")
    path = tmp_path / "registry.csv"
    path.write_text("\n".join(lines) + "\n")
    monkeypatch.setattr(downloads, "_REGISTRY", path)
    downloads._registry.cache_clear()
    yield contents
    downloads._registry.cache_clear()


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path / "cache"))


def test_files_are_fetched_once_and_whole(server, registry, tmp_path):
    paths = download("made", base_url=server.url + "/")
    assert paths == [tmp_path / "cache" / "made" / name for name in registry]
    assert [path.read_bytes() for path in paths] == list(registry.values())
    assert len(server.handler.asked) == 2
    assert server.handler.asked[1] == f"/some/where/{COMMIT}/deep/b%20c.bvh"
    assert download("made", base_url=server.url) == paths
    assert len(server.handler.asked) == 2
    # One that was damaged since is fetched again.
    paths[0].write_bytes(b"other")
    assert download("made", ["a.bvh"], base_url=server.url) == paths[:1]
    assert paths[0].read_bytes() == registry["a.bvh"]
    assert len(server.handler.asked) == 3


def test_a_folder_may_be_given(server, registry, tmp_path):
    (path,) = download("made", ["b c.bvh"], tmp_path / "mine", base_url=server.url)
    assert path == tmp_path / "mine" / "made" / "b c.bvh"
    assert not (tmp_path / "cache").exists()


def refused(tmp_path, match, url):
    """Return the one sentence with which a download fails, after which nothing is there."""
    with pytest.raises(DownloadError, match=match) as error:
        download("made", ["a.bvh"], tmp_path / "mine", base_url=url)
    text = str(error.value)
    assert "\n" not in text
    assert "a.bvh" in text
    assert f"{url}/some/where/{COMMIT}/deep/a.bvh" in text
    assert [p for p in (tmp_path / "mine").rglob("*") if p.is_file()] == []
    return text


def test_another_content_is_refused(server, registry, tmp_path):
    (served,) = (tmp_path / "served").rglob("a.bvh")
    served.write_bytes(b"something else")
    refused(tmp_path, "has not the SHA-256 .* of the registry", server.url)


def test_a_download_that_breaks_off_leaves_nothing(server, registry, tmp_path):
    server.handler.broken = True
    refused(tmp_path, "cannot be fetched from", server.url)
    server.handler.broken = False
    assert download("made", ["a.bvh"], tmp_path / "mine", base_url=server.url)[0].is_file()


def test_an_interrupt_leaves_nothing(server, registry, tmp_path, monkeypatch):
    import pooch

    def interrupted(self, url, output, *_, **__):
        Path(output).write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(pooch.HTTPDownloader, "__call__", interrupted)
    with pytest.raises(KeyboardInterrupt):
        download("made", folder=tmp_path / "mine", base_url=server.url)
    assert [p for p in (tmp_path / "mine").rglob("*") if p.is_file()] == []


def test_missing_files_and_no_network_are_one_sentence(server, registry, tmp_path):
    (served,) = (tmp_path / "served").rglob("a.bvh")
    served.unlink()
    refused(tmp_path, r"\(404\), expected a network that reaches it", server.url)
    refused(tmp_path, r"\(ConnectionError\), expected a network", "http://127.0.0.1:9")
    refused(tmp_path, r"\(InvalidSchema\)", "ftps://127.0.0.1")


def test_a_folder_that_cannot_be_written_is_named(server, registry, tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(DownloadError, match=r"a\.bvh from .* cannot be kept in .*file") as error:
        download("made", folder=tmp_path / "file", base_url=server.url)
    assert "\n" not in str(error.value)


def test_unknown_names_list_the_known_ones(registry):
    with pytest.raises(ValueError, match="dataset must be one of made, got 'cmu'"):
        download("cmu")
    with pytest.raises(ValueError, match=r"names has 'c\.bvh', expected files of made: a\.bvh, b"):
        download("made", ["c.bvh"])
    with pytest.raises(ValueError, match=r"names must be a list of names, got 'a\.bvh'"):
        download("made", "a.bvh")


def test_the_registry_is_the_one_of_the_originals(real_data):
    with open(real_data / "registry.csv", newline="") as file:
        known = [tuple(line.values()) for line in csv.DictReader(file)]
    ours = [tuple(vars(entry).values()) for entry in downloads._registry()]
    assert ours == known
    for name in ("60_10_scaled.bvh", "61_10_scaled.bvh", "02_01.amc"):
        (entry,) = (entry for entry in downloads._registry() if entry.name == name)
        content = (real_data / "originals" / name).read_bytes()
        assert hashlib.sha256(content).hexdigest() == entry.sha256
        assert len(content) == int(entry.bytes)


def test_every_entry_can_be_an_address():
    entries = downloads._registry()
    assert len({(entry.dataset, entry.name) for entry in entries}) == len(entries)
    for entry in entries:
        assert len(entry.commit) == 40
        assert len(entry.sha256) == 64
        assert entry.licence == "CMU"
    names = {entry.name for entry in entries if entry.dataset == "cmu-salsa"}
    for trial in downloads.SALSA_TRIALS:
        assert {f"60_{trial}_scaled.bvh", f"61_{trial}_scaled.bvh"} <= names
    assert downloads.CMU_ACKNOWLEDGEMENT in downloads.CMU_TERMS


def test_originals_come_through(server, real_data, tmp_path):
    names = ["60_10_scaled.bvh", "61_10_scaled.bvh"]
    for entry in downloads._chosen("cmu-salsa", names):
        served = tmp_path / "served" / entry.repository / entry.commit / entry.path
        served.parent.mkdir(parents=True)
        shutil.copy(real_data / "originals" / entry.name, served)
    paths = download("cmu-salsa", names, base_url=server.url)
    assert [path.name for path in paths] == names


@pytest.fixture
def nowhere(tmp_path, monkeypatch):
    """A working folder that has no shared data beside it."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path


def put_archives(folder, frames=3):
    folder.mkdir(parents=True)
    for trial, dance in zip(
        downloads.SALSA_TRIALS, synthetic_dances(10, frames=frames), strict=True
    ):
        dance = type(dance)(dance.positions, dance.skeleton, 30.0)
        save_motion(dance, folder / f"cmu_60_61_{trial}.npz")


@pytest.mark.parametrize("place", ["cache/cmu_salsa_pairs", "cache", "shared/data/cmu_salsa_pairs"])
def test_clips_are_found_where_they_are(nowhere, place):
    with pytest.raises(FileNotFoundError, match=r'downloads\.download\("cmu-salsa"\) fetches'):
        salsa_pairs()
    put_archives(nowhere / place)
    clips = salsa_pairs()
    assert [clip.name for clip in clips] == [f"cmu_60_61_{t}" for t in downloads.SALSA_TRIALS]


def test_a_folder_that_is_given_is_the_only_one(nowhere):
    put_archives(nowhere / "cache" / "cmu_salsa_pairs")
    with pytest.raises(FileNotFoundError, match="the ten salsa clips are not in other; "):
        salsa_pairs("other")
    assert len(salsa_pairs(nowhere / "cache")) == 10


def test_the_first_place_wins(nowhere):
    put_archives(nowhere / "shared" / "data" / "cmu_salsa_pairs")
    assert salsa_pairs()[0].frames == 3
    put_archives(nowhere / "cache" / "cmu_salsa_pairs", frames=4)
    assert salsa_pairs()[0].frames == 4
    put_archives(nowhere / "mine", frames=5)
    assert salsa_pairs(nowhere / "mine")[0].frames == 5


def test_bvh_files_of_the_cache_are_read(nowhere, real_data, monkeypatch):
    cache = nowhere / "cache" / "cmu-salsa"
    cache.mkdir(parents=True)
    for trial in downloads.SALSA_TRIALS:
        with pytest.raises(FileNotFoundError):
            salsa_pairs()
        for subject in (60, 61):
            original = real_data / "originals" / f"{subject}_10_scaled.bvh"
            (cache / f"{subject}_{trial}_scaled.bvh").symlink_to(original)
    monkeypatch.setattr(downloads, "SALSA_TRIALS", ("10",))  # reading all ten takes seconds
    (clip,) = salsa_pairs()
    assert (clip.name, clip.frames, clip.fps) == ("cmu_60_61_10", 584, 30.0)


def test_the_real_clips_are_found_where_the_variable_says(real_data, monkeypatch):
    monkeypatch.setenv("PROBMOTION_DATA", str(real_data))
    clips = salsa_pairs()
    assert len(clips) == 10
    np.testing.assert_array_equal([clip.fps for clip in clips], 30.0)
