"""Seeded mutations of files: of their bytes, and of the content of valid JSON and npz files."""

import copy
import io
import json
import zipfile

import numpy as np

SNIPPETS = [
    *(b"\r", b"\n", b"\r\n", b"\t", b"\x00", b"\xff", b"\xef\xbb\xbf", b"{", b"}", b"[", b"]"),
    *(b'"', b",", b":", b"nan", b"NaN", b"-Infinity", b"null", b"true", b"-1", b"0", b"1e308"),
    *(b"1e999", b"-1e-400", b"9" * 30, b"9" * 5000, b"_", b"MOTION", b"ROOT a", b"JOINT Knee"),
    *(b"End Site", b"CHANNELS 0", b"Frames: 999999999", b"Frame Time: 1e-9", b"[" * 5000),
    *(b"\xd9\xa1", b"(99999999999,)", b"<f8", b"|O", b"PK\x01\x02", b"\xe2\x80\xa8"),
]
VALUES = [
    *(None, True, 0, -1, 1e308, float("nan"), float("inf"), 10**400, 10**12, "", "x", "../../x"),
    *("<script>", [], {}, [[]], {"x": 1}, "\ud800", [None], [1e308], -0.5),
]


def mutated(rng, name, content):
    """Return the content of a file after one to four mutations."""
    if name.endswith((".json", ".zarray", ".zattrs", ".zgroup")) and rng.random() < 0.5:
        return json.dumps(_of_json(rng, json.loads(content))).encode()
    if name.endswith(".npz") and rng.random() < 0.5:
        return _of_archive(rng, content)
    for _ in range(rng.integers(1, 5)):
        content = _BYTES[rng.integers(len(_BYTES))](rng, content)
    return content


def _cut(rng, content):
    return content[: rng.integers(len(content) + 1)]


def _insert(rng, content):
    at = rng.integers(len(content) + 1)
    return content[:at] + SNIPPETS[rng.integers(len(SNIPPETS))] + content[at:]


def _overwrite(rng, content):
    at = rng.integers(len(content) + 1)
    own = rng.random() < 0.5
    new = rng.bytes(rng.integers(1, 20)) if own else SNIPPETS[rng.integers(len(SNIPPETS))]
    return content[:at] + new + content[at + len(new) :]


def _flip(rng, content):
    changed = bytearray(content)
    for at in rng.integers(len(content), size=rng.integers(1, 9)) if content else ():
        changed[at] ^= 1 << rng.integers(8)
    return bytes(changed)


def _move_line(rng, content):
    lines = content.split(b"\n")
    moved = lines.pop(rng.integers(len(lines)))
    at = rng.integers(len(lines) + 1)
    lines[at:at] = [moved] * rng.integers(3)
    return b"\n".join(lines)


def _ends(rng, content):
    at = rng.integers(len(content) + 1)
    end = (b"\r\n", b"\r", b" \n")[rng.integers(3)]
    return content[:at] + content[at:].replace(b"\n", end)


_BYTES = (_cut, _insert, _overwrite, _flip, _move_line, _ends)


def _of_json(rng, content):
    """Return JSON data with one to three values replaced, swapped, removed or nested."""
    content = copy.deepcopy(content)
    for _ in range(rng.integers(1, 4)):
        places = list(_places(content))
        if not places:
            break
        parent, key = places[rng.integers(len(places))]
        other, there = places[rng.integers(len(places))]
        kind = rng.integers(5)
        if kind == 0:
            parent[key] = copy.deepcopy(VALUES[rng.integers(len(VALUES))])
        elif kind == 1:
            parent[key], other[there] = copy.deepcopy(other[there]), copy.deepcopy(parent[key])
        elif kind == 2:
            del parent[key]
        elif kind == 3 and isinstance(parent, dict):
            parent[str(VALUES[rng.integers(len(VALUES))])] = parent.pop(key)
        else:
            parent[key] = [parent[key]]
    return content


def _places(content):
    """Yield every list or dictionary in JSON data with each of its indices or keys."""
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in list(items):
        yield content, key
        if isinstance(value, dict | list):
            yield from _places(value)


def _of_archive(rng, content):
    """Return a valid zip with arrays of other values, types, shapes, names or headers."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for _ in range(rng.integers(1, 3)):
        name = list(members)[rng.integers(len(members))]
        other = list(members)[rng.integers(len(members))]
        kind = rng.integers(4)
        if kind == 0:
            members[name], members[other] = members[other], members[name]
        elif kind == 1:
            for _ in range(rng.integers(1, 4)):
                members[name] = _BYTES[rng.integers(4)](rng, members[name])
        else:
            try:
                array = np.lib.format.read_array(io.BytesIO(members[name]))
                members[name] = _npy(_of_array(rng, array))
            except Exception:  # an earlier mutation damaged the member
                members[name] = b""
    if rng.random() < 0.1:
        members.pop(name)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return file.getvalue()


def _of_array(rng, array):
    kind = rng.integers(6)
    if kind == 0 and array.dtype.kind == "f" and array.size:
        array = array.copy()
        bad = (np.nan, np.inf, -np.inf, 1e308, -1e30, 0.0)
        array.flat[rng.integers(array.size)] = bad[rng.integers(len(bad))]
    elif kind == 1:
        kinds = ("i1", "f2", "c16", "U3", "S2", "?", "O", "M8[s]", "V4", "i4,f4", ">f8")
        array = array.astype(kinds[rng.integers(len(kinds))])
    elif kind == 2:
        array = array[np.newaxis] if rng.random() < 0.5 else np.stack([array] * 2, axis=-1)
    elif kind == 3:
        array = array.ravel()
    elif kind == 4 and array.ndim:
        axis = rng.integers(array.ndim)
        array = np.delete(array, slice(0, rng.integers(1, array.shape[axis] + 1)), axis)
    else:
        array = np.array(VALUES[rng.integers(len(VALUES))], dtype=object).astype(array.dtype)
    return array


def _npy(array):
    file = io.BytesIO()
    np.lib.format.write_array(file, array, allow_pickle=True)
    return file.getvalue()
