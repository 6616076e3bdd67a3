"""Downloads by name from a local server: verification, caching and errors."""

import csv
import hashlib
import threading
import zlib
from contextlib import suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from probmotion.data import downloads
from probmotion.data.downloads import DownloadError, download, salsa_pairs
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.io.files import save

COMMIT = "0" * 40


class Handler(SimpleHTTPRequestHandler):
    """Serve a folder and record requests; truncate responses if ``broken``.

    If ``endless``, send zeros, gzipped to a thousandth, until the client has enough.
    """

    requests: list[str]
    broken: bool
    endless: bool

    def do_GET(self):
        self.requests.append(self.path)
        if type(self).endless:
            self.send_response(200)
            self.send_header("Content-Encoding", "gzip")
            self.end_headers()
            zeros = zlib.compressobj(9, wbits=31)
            with suppress(ConnectionError):
                for _ in range(10_000):
                    self.wfile.write(zeros.compress(bytes(2**20)))
            self.close_connection = True
        elif type(self).broken:
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
    """Server of ``tmp_path/served`` with attributes ``url`` and ``handler``."""
    served = tmp_path / "served"
    served.mkdir()
    handler = type("OwnHandler", (Handler,), {"requests": [], "broken": False, "endless": False})
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
    """Contents of two files that are served and registered as data set ``sample``."""
    contents = {"a.bvh": b"HIERARCHY", "b c.bvh": b"MOTION" * 1000}
    folder = tmp_path / "served" / "some" / "where" / COMMIT / "deep"
    folder.mkdir(parents=True)
    lines = ["dataset,repository,commit,path,sha256,bytes,licence"]
    for name, content in contents.items():
        (folder / name).write_bytes(content)
        digest = hashlib.sha256(content).hexdigest()
        lines.append(f"sample,some/where,{COMMIT},deep/{name},{digest},{len(content)},CMU")
    path = tmp_path / "registry.csv"
    path.write_text("\n".join(lines) + "\n")
    monkeypatch.setattr(downloads, "_REGISTRY", path)
    downloads._registry.cache_clear()
    yield contents
    downloads._registry.cache_clear()


def test_files_are_downloaded_once(server, registry, no_data):
    paths = download("sample", base_url=server.url + "/")
    assert paths == [no_data / "cache" / "sample" / name for name in registry]
    assert [path.read_bytes() for path in paths] == list(registry.values())
    assert len(server.handler.requests) == 2
    assert server.handler.requests[1] == f"/some/where/{COMMIT}/deep/b%20c.bvh"
    assert download("sample", base_url=server.url) == paths
    assert len(server.handler.requests) == 2
    # A damaged file is downloaded again.
    paths[0].write_bytes(b"other")
    assert download("sample", ["a.bvh"], base_url=server.url) == paths[:1]
    assert paths[0].read_bytes() == registry["a.bvh"]
    assert len(server.handler.requests) == 3


def assert_fails(tmp_path, match, url):
    """Check that a download fails with its address in the message and leaves no file."""
    with pytest.raises(DownloadError, match=match) as error:
        download("sample", ["a.bvh"], tmp_path / "mine", base_url=url)
    assert f"{url}/some/where/{COMMIT}/deep/a.bvh" in str(error.value)
    assert [p for p in (tmp_path / "mine").rglob("*") if p.is_file()] == []


def test_failed_download_leaves_no_file(server, registry, tmp_path):
    (served,) = (tmp_path / "served").rglob("a.bvh")
    server.handler.broken = True
    assert_fails(tmp_path, "cannot be downloaded from", server.url)
    server.handler.broken = False
    (path,) = download("sample", ["a.bvh"], tmp_path / "other", base_url=server.url)
    assert path == tmp_path / "other" / "sample" / "a.bvh"
    served.write_bytes(b"something")
    assert_fails(tmp_path, "does not have the SHA-256 .* of the registry", server.url)
    served.write_bytes(b"something else")
    assert_fails(tmp_path, "is larger than the 9 bytes of the registry", server.url)
    server.handler.endless = True
    assert_fails(tmp_path, "is larger than the 9 bytes of the registry", server.url)
    server.handler.endless = False
    served.unlink()
    assert_fails(tmp_path, r"\(404\); check the network", server.url)
    assert_fails(tmp_path, r"\(ConnectionError\); check the network", "http://127.0.0.1:9")


def test_invalid_folder_and_names(server, registry, tmp_path):
    (tmp_path / "file").write_text("no folder")
    for error, message, options in (
        (DownloadError, r"a\.bvh from .* cannot be written to .*f", {"folder": tmp_path / "file"}),
        (ValueError, "dataset must be one of sample, got 'cmu'", {"dataset": "cmu"}),
        (ValueError, r"names must be files of sample \(a\.bvh, b c", {"names": ["c.bvh"]}),
        (ValueError, r"names must be a list of names, got 'a\.bvh'", {"names": "a.bvh"}),
    ):
        with pytest.raises(error, match=message):
            download(**{"dataset": "sample", "base_url": server.url} | options)


def test_registry_matches_the_original_files(real_data):
    with open(real_data / "registry.csv", newline="") as file:
        known = [tuple(line.values()) for line in csv.DictReader(file)]
    assert list(downloads._registry()) == known
    for name in ("60_10_scaled.bvh", "61_10_scaled.bvh", "02_01.amc"):
        (entry,) = (entry for entry in downloads._registry() if entry.name == name)
        content = (real_data / "originals" / name).read_bytes()
        assert hashlib.sha256(content).hexdigest() == entry.sha256
        assert len(content) == int(entry.bytes)


def test_registry_is_complete():
    entries = downloads._registry()
    assert len({(entry.dataset, entry.name) for entry in entries}) == len(entries)
    names = {entry.name for entry in entries if entry.dataset == "cmu-salsa"}
    for trial in downloads.SALSA_TRIALS:
        assert {f"60_{trial}_scaled.bvh", f"61_{trial}_scaled.bvh"} <= names


def write_archives(folder, frames):
    folder.mkdir(parents=True, exist_ok=True)
    dances = synthetic_dances(10, frames=frames)
    for trial, dance in zip(downloads.SALSA_TRIALS, dances, strict=True):
        dance = type(dance)(dance.positions, dance.skeleton, 30.0)
        save(dance, folder / f"cmu_60_61_{trial}.npz")


def test_folders_are_searched_in_order(no_data):
    with pytest.raises(FileNotFoundError, match=r'downloads\.download\("cmu-salsa"\) downloads'):
        salsa_pairs()
    folders = ("shared/data/cmu_salsa_pairs", "cache", "cache/cmu_salsa_pairs")
    for frames, folder in enumerate(folders):
        write_archives(no_data / folder, frames + 1)
        clips = salsa_pairs()
        assert [clip.name for clip in clips] == [f"cmu_60_61_{t}" for t in downloads.SALSA_TRIALS]
        assert clips[0].frames == frames + 1
    with pytest.raises(FileNotFoundError, match="the ten salsa clips are not in mine; "):
        salsa_pairs("mine")
    write_archives(no_data / "mine", 5)
    assert salsa_pairs(no_data / "mine")[0].frames == 5


def test_bvh_files_are_found(no_data, real_data, monkeypatch):
    cache = no_data / "cache" / "cmu-salsa"
    cache.mkdir(parents=True)
    for trial in downloads.SALSA_TRIALS:
        for subject in (60, 61):
            original = real_data / "originals" / f"{subject}_10_scaled.bvh"
            (cache / f"{subject}_{trial}_scaled.bvh").symlink_to(original)
    (cache / "60_01_scaled.bvh").unlink()
    with pytest.raises(FileNotFoundError):
        salsa_pairs()
    monkeypatch.setattr(downloads, "SALSA_TRIALS", ("10",))  # reading all ten takes seconds
    (clip,) = salsa_pairs()
    assert (clip.name, clip.frames, clip.fps) == ("cmu_60_61_10", 584, 30.0)
