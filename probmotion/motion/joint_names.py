"""Canonical joint names across the naming schemes of data sets and programs.

Canonical names are ``pelvis lower_spine spine chest neck upper_neck head head_top nose tail`` and,
with the prefix ``left_`` or ``right_``, ``eye ear collar shoulder elbow wrist palm hand fingers
thumb hip_joint hip knee ankle heel foot big_toe small_toe toe front_paw back_paw``. ``foot`` is
the ball of the foot, as in SMPL, and ``toe`` is the tip of the foot.

Joint names in files are ambiguous. A BVH joint is named after the bone that starts there
(``LeftLeg`` is a knee), an ASF joint after the bone that ends there (``ltibia`` is an ankle).
``left_foot`` is the ankle if the skeleton has no ``left_ankle``, else the ball of the foot. The
canonical names of all joints of a skeleton are therefore determined together.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

__all__ = ["canonical_names", "mirrored_name"]

# Possible meanings of each word (lower case, without separators), most likely first.
_CENTRAL: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("pelvis", "hip", "hips", "midhip", "hipcentre", "hipcenter"), ("pelvis",)),
    "root": ("pelvis", "root"),
    "lowerback": ("lower_spine",),
    "lowerspine": ("lower_spine",),
    "thorax": ("neck", "chest"),
    "neck": ("neck",),
    "lowerneck": ("neck", "lower_neck"),
    "upperneck": ("neck", "upper_neck"),
    "neck1": ("upper_neck",),
    "head": ("head",),
    **dict.fromkeys(("headtop", "headtopend", "topofhead"), ("head_top",)),
    **dict.fromkeys(("nose", "neck/nose"), ("nose",)),
    **dict.fromkeys(("tail", "tail0", "tailbase", "tailroot", "rootoftail"), ("tail",)),
}
_SIDED: dict[str, tuple[str, ...]] = {
    **{word: (word,) for word in ("eye", "ear", "elbow", "heel", "knee", "ankle", "thumb")},
    **dict.fromkeys(("collar", "clavicle", "collarbone"), ("collar",)),
    **dict.fromkeys(("arm", "uparm", "upperarm", "shldr"), ("shoulder",)),
    "shoulder": ("shoulder", "collar"),
    **dict.fromkeys(("forearm", "lowerarm"), ("elbow",)),
    "wrist": ("wrist",),
    "palm": ("palm",),
    "hand": ("wrist", "hand"),
    **dict.fromkeys(("fingers", "finger", "fingerbase", "mid1"), ("fingers",)),
    **dict.fromkeys(("hip", "upleg", "upperleg", "thigh"), ("hip",)),
    "hipjoint": ("hip", "hip_joint"),
    "buttock": ("hip_joint",),
    **dict.fromkeys(("leg", "lowerleg", "shin", "calf"), ("knee",)),
    "foot": ("ankle", "foot"),
    **dict.fromkeys(("toebase", "ball"), ("foot",)),
    **dict.fromkeys(("toe", "toes"), ("foot", "toe")),
    "bigtoe": ("big_toe",),
    "smalltoe": ("small_toe",),
    **dict.fromkeys(("frontpaw", "fpaw"), ("front_paw",)),
    **dict.fromkeys(("backpaw", "hindpaw", "bpaw"), ("back_paw",)),
    # Joint centres of marker sets.
    "hjc": ("hip",),
    "kjc": ("knee",),
    "ajc": ("ankle",),
    "sjc": ("shoulder",),
    "ejc": ("elbow",),
    "wjc": ("wrist",),
}
# Canonical names for CMU's ASF files, which name a joint after the bone that ends there.
_ASF_CENTRAL = {
    "root": "pelvis", "lowerback": "lower_spine", "upperback": "spine", "thorax": "chest",
    "lowerneck": "neck", "upperneck": "upper_neck", "head": "head",
}  # fmt: skip
_ASF_SIDED = {
    "hipjoint": "hip", "femur": "knee", "tibia": "ankle", "foot": "foot", "toes": "toe",
    "clavicle": "shoulder", "humerus": "elbow", "radius": "wrist", "wrist": "palm", "hand": "hand",
    "fingers": "fingers", "thumb": "thumb",
}  # fmt: skip
_ASF_MARKS = frozenset(side + bone for side in "lr" for bone in ("femur", "tibia", "humerus"))
# Canonical names of joints called ``…_end``, by the canonical name of the parent.
_END_OF = {
    "ankle": "foot", "foot": "toe", "head": "head_top", "fingers": "finger_tips",
    "thumb": "thumb_tip",
}  # fmt: skip
_PAW_OF = {"fingers": "front_paw", "foot": "back_paw"}  # if the skeleton has a tail

_PERSON = re.compile(r"^(?P<person>[^:]*):(?P<joint>.+)$")
_MIXAMO = re.compile(r"^mixamorig\d*[:_]")
_END = re.compile(r"^(?P<joint>.+?)[_ .]?(?:[_ .]end(?: ?site)?|End|Nub)$", re.IGNORECASE)
_TRUNK = re.compile(r"^(?P<word>abdomen|spine|chest|upperchest)(?P<number>\d*)$")  # spine1, …
_SIDES = (
    re.compile(r"^(?P<side>left|right)[_ .-]*(?P<part>.+)$", re.IGNORECASE),
    re.compile(r"^(?P<part>.+)[_ .-](?P<side>left|right|l|r)$", re.IGNORECASE),
    re.compile(r"^(?P<side>l|r)[_ .-](?P<part>.+)$", re.IGNORECASE),
    re.compile(r"^(?P<side>[lLrR])(?P<part>[A-Z].*)$"),
)
_SHORT_SIDE = re.compile(r"^(?P<side>[lLrR])(?P<part>[a-z].*)$")
_MIRRORED = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "l": "r", "L": "R"}


def canonical_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return the canonical names of the joints of one skeleton.

    Parameters
    ----------
    names : sequence of str
        All joint names of the skeleton. A prefix ``person:`` is preserved if prefixes differ;
        a prefix common to all joints is a rig name and is dropped.

    Returns
    -------
    tuple of str
        Canonical names; unknown names are unchanged.
    """
    people = [_person_of(name) for name in names]
    several = len(set(people)) > 1
    result = list(names)
    for person in dict.fromkeys(people):
        members = [index for index, other in enumerate(people) if other == person]
        bare = [_without_person(names[index]) for index in members]
        for index, canonical in zip(members, _names_of_one(bare), strict=True):
            result[index] = f"{person}:{canonical}" if several and person else canonical
    return tuple(result)


def _person_of(name: str) -> str:
    """Return the ``person`` prefix of a joint name, or ``""`` if it has none."""
    match = _PERSON.match(_MIXAMO.sub("", name))
    return match["person"] if match else ""


def mirrored_name(name: str) -> str | None:
    """Return the name of a left joint's right counterpart in the same naming scheme, or None.

    ``left_knee`` → ``right_knee``, ``lShin`` → ``rShin``, ``lowerback`` → None.
    """
    bare = _without_person(name)
    match = _side(bare)
    if match is None or match["side"] not in _MIRRORED:
        return None
    start = len(name) - len(bare) + match.start("side")
    return name[:start] + _MIRRORED[match["side"]] + name[start + len(match["side"]) :]


def _names_of_one(names: list[str]) -> list[str]:
    """Return the canonical names of one person's joints."""
    if _ASF_MARKS & set(names):
        return [_asf_name(name) for name in names]
    meanings = [_meanings(name) for name in names]
    for index, meaning in _trunk(names).items():
        meanings[index] = (meaning,)
    result = list(names)
    used: set[str] = set()
    # Unambiguous names are assigned first, then canonical ones. Joint order is irrelevant.
    for index in sorted(
        range(len(names)),
        key=lambda i: (len(meanings[i]), meanings[i][:1] != (names[i],), _word(names[i])),
    ):
        unused = [meaning for meaning in meanings[index] if meaning not in used]
        if unused:
            result[index] = unused[0]
            used.add(unused[0])
    known = dict(zip(names, result, strict=True))
    for index, name in enumerate(names):
        if result[index] == name and (match := _END.match(name)):
            unsided = _meanings(match["joint"]) or (match["joint"],)
            end = _in_side(known.get(match["joint"], unsided[0]), _END_OF)
            if end is not None and end not in used:
                result[index] = end
                used.add(end)
    if "tail" in used:
        result = [_in_side(name, _PAW_OF) or name for name in result]
    return result


def _meanings(name: str) -> tuple[str, ...]:
    """Return the possible meanings of a name, most likely first; empty if it is unknown."""
    if _word(name) in _CENTRAL:
        return _CENTRAL[_word(name)]
    match = _side(name)
    if match is None:
        return ()
    side = "left_" if match["side"][0] in "lL" else "right_"
    part = _word(match["part"])
    if part in _SIDED:
        return tuple(side + meaning for meaning in _SIDED[part])
    return (side + _ASF_SIDED[part],) if part in _ASF_SIDED else ()


def _trunk(names: list[str]) -> dict[int, str]:
    """Return the canonical names of the numbered joints between pelvis and neck, by index."""
    order = ("abdomen", "spine", "chest", "upperchest")
    joints = []
    for index, name in enumerate(names):
        if match := _TRUNK.match(_word(name)):
            joints.append((order.index(match["word"]), int(match["number"] or 0), index))
    joints.sort()
    if len(joints) == 1:
        word = order[joints[0][0]]
        return {joints[0][2]: "chest" if "chest" in word else "spine"}
    middle = ["spine"] if len(joints) == 2 else ["lower_spine", "spine"]
    canonical = [*middle, *[""] * (len(joints) - len(middle) - 1), "chest"]
    return {index: name for (_, _, index), name in zip(joints, canonical, strict=False) if name}


def _asf_name(name: str) -> str:
    if name in _ASF_CENTRAL:
        return _ASF_CENTRAL[name]
    if name[1:] in _ASF_SIDED and name[0] in "lr":
        return ("left_" if name[0] == "l" else "right_") + _ASF_SIDED[name[1:]]
    return name


def _in_side(name: str, table: dict[str, str]) -> str | None:
    """Look up a canonical name in ``table``, preserving its side."""
    for side in ("left_", "right_", ""):
        if name.startswith(side):
            meaning = table.get(name.removeprefix(side))
            return None if meaning is None else side + meaning
    return None


def _side(name: str) -> re.Match[str] | None:
    """Match the side and part of a name; None if it has no side, such as ``lowerback``."""
    if _word(name) in _CENTRAL or _TRUNK.match(_word(name)):
        return None
    for pattern in _SIDES:
        if match := pattern.match(name):
            return match
    match = _SHORT_SIDE.match(name)
    if match and (_word(match["part"]) in _SIDED or _word(match["part"]) in _ASF_SIDED):
        return match
    return None


def _without_person(name: str) -> str:
    match = _PERSON.match(_MIXAMO.sub("", name))
    return match["joint"] if match else _MIXAMO.sub("", name)


def _word(name: str) -> str:
    """Return a name in lower case without separators."""
    return re.sub(r"[\s_.-]", "", name).lower()
