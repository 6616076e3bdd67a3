"""Procedural couple dances: steps, turns under raised arms and changes of hold.

A dance is a sequence of eight-beat figures. Position and heading of the couple and the distance
between the partners are smooth functions of time. Feet step to points below the hip at mid-stance;
the hold places the hands. Bones have constant lengths, and elbows and knees bend anatomically.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from probmotion import seeds
from probmotion.data.synthetic.choreography import HOLDS, Dance, draw_dance, level, rise
from probmotion.geometry.rotations import euler_to_matrix
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive

__all__ = ["bent_limb", "synthetic_dances"]

# Offsets from the parent in body coordinates (left, up, forward), fractions of the body height.
_SPINE, _CHEST, _NECK = (0.0, 0.10, 0.0), (0.0, 0.09, 0.0), (0.0, 0.10, -0.008)
_HEAD, _SHOULDER, _HIP = (0.0, 0.055, 0.022), (0.115, 0.075, -0.005), (0.057, 0.015, 0.0)
_ARM, _LEG, _ANKLE = (0.170, 0.146), (0.245, 0.246), 0.045
_SIDES = {"left": 1.0, "right": -1.0}
_UP = np.array([0.0, 1.0, 0.0])

_STEP_BEATS = 0.8  # duration of a step, beats
_WRIST_TO_GRIP = 0.05  # metres
# Largest extension (fraction of the length), softness of limits (m), cosine of the smallest angle.
_MAX_EXTENSION = 0.99
_SOFTNESS = 0.01
_MIN_ANGLE_COSINE = np.cos(np.deg2rad(30.0))
Joints = dict[str, np.ndarray]
"""Positions (L, 3) by joint; key ``frame`` is the orientation (L, 3, 3) of the chest."""


def synthetic_dances(
    n: int = 20, *, frames: int = 90, fps: float = 30.0, seed: int = 0
) -> list[Motion]:
    """Return ``n`` dances of ``frames`` frames at ``fps`` frames per second, on ``pair17``.

    Dances are named ``dance-0``, …; ``person0`` leads and is about 1.7 m tall, ``person1`` about
    1.6 m. Rhythm, figures, holds, steps, turns and posture depend only on ``seed`` and the index of
    the dance.
    """
    check_count("n", n)
    check_count("frames", frames)
    check_positive("fps", fps)
    time = np.arange(frames) / fps
    skeleton = Skeleton.preset("pair17")
    names = Skeleton.preset("person17").joint_names
    dances = []
    for number in range(n):
        dance = draw_dance(seeds.generator(seed, "dance", number), time[-1])
        bodies = [_trunk_and_legs(dance, person, time) for person in range(2)]
        _join_hands(dance, bodies, time)
        positions = np.stack([body[name] for body in bodies for name in names], axis=1)
        dances.append(Motion(positions, skeleton, fps, name=f"dance-{number}"))
    return dances


def _trunk_and_legs(dance: Dance, person: int, time: np.ndarray) -> Joints:
    """Return the joints of a person's trunk and legs, and the chest's orientation."""
    height, beats = dance.heights[person], dance.beats(time)
    mirror = 1.0 - 2.0 * person  # the follower mirrors the leader
    root, yaw = dance.position_and_yaw(time, person)
    roll = mirror * 2.0 * dance.sway * np.sin(np.pi * beats)
    lean = dance.lean[person] + 0.04 * dance.wander(5 + person, time)
    twist = mirror * dance.twist * np.cos(np.pi * beats)
    zero = np.zeros_like(time)
    pelvis = _frame(yaw - 0.5 * twist, lean, roll)
    spine = _frame(yaw, lean, zero)
    chest = _frame(yaw + 0.5 * twist, lean + 0.02, -0.5 * roll)
    nod = 0.12 * dance.wander(7 + person, time)
    gaze = _frame(yaw + 0.2 * dance.wander(9 + person, time), lean + nod, zero)
    hip_height = _ANKLE + sum(_LEG) * dance.bend[person] - _HIP[1]
    bob = 0.008 * np.cos(2 * np.pi * beats)
    joints = {"pelvis": root + _UP * (height * hip_height + bob)[:, None], "frame": chest}
    for name, parent, frame, offset in (
        ("spine", "pelvis", pelvis, _SPINE),
        ("chest", "spine", spine, _CHEST),
        ("neck", "chest", chest, _NECK),
        ("head", "neck", gaze, _HEAD),
    ):
        joints[name] = joints[parent] + height * _rotated(frame, offset)
    for side, sign in _SIDES.items():
        shoulder = _rotated(chest, np.multiply((sign, 1.0, 1.0), _SHOULDER))
        joints[f"{side}_shoulder"] = joints["chest"] + height * shoulder
        hip = joints["pelvis"] + height * _rotated(pelvis, np.multiply((sign, 1.0, 1.0), _HIP))
        lengths, forward = (height * _LEG[0], height * _LEG[1]), (0.15 * sign, 0.0, 1.0)
        ankle = _foot(dance, person, sign, time)
        knee, ankle = bent_limb(hip, ankle, lengths, _rotated(pelvis, forward))
        joints |= {f"{side}_hip": hip, f"{side}_knee": knee, f"{side}_ankle": ankle}
    return joints


def _foot(dance: Dance, person: int, sign: float, time: np.ndarray) -> np.ndarray:
    """Return the target of an ankle, (L, 3), which is planted or swings to the next foothold."""
    height = dance.heights[person]
    odd = float((sign > 0) == (person == 0))  # the feet step on alternate beats
    beats = dance.beats(time)
    stepped = 2 * np.floor((beats - odd) / 2) + odd
    progress = rise((beats - stepped) / _STEP_BEATS)
    footholds = []
    for step in (stepped - 2, stepped):
        # The foothold is below the hip at mid-stance.
        middle = (step + 1 + _STEP_BEATS / 2 - dance.start) * dance.beat
        root, yaw = dance.position_and_yaw(middle, person)
        footholds.append(root + (sign * (_HIP[0] + 0.01) * height) * level(yaw + np.pi / 2))
    move = footholds[1] - footholds[0]
    lift = np.minimum(0.03 + 0.15 * np.linalg.norm(move, axis=-1), 0.1)
    ankle = footholds[0] + progress[:, None] * move
    return ankle + _UP * (_ANKLE * height + lift * np.sin(np.pi * progress) ** 2)[:, None]


def _join_hands(dance: Dance, bodies: list[Joints], time: np.ndarray) -> None:
    """Add elbows and wrists to both bodies, with hands placed by hold and turn."""
    weights = dance.weights(time)
    weight = {
        hold: np.array([figure.hold == hold for figure in dance.figures]) @ weights
        for hold in HOLDS
    }
    raised = [dance.raised(time, person) for person in range(2)]
    lead, follow = bodies
    for person, body in enumerate(bodies):
        for side, sign in _SIDES.items():
            shoulder, frame = body[f"{side}_shoulder"], body["frame"]
            swing = 0.05 * np.sin(np.pi * dance.beats(time))[:, None]
            free = _rotated(frame, (0.08 * sign, -0.34, 0.18))
            free = free + swing * _rotated(frame, (0.0, 0.3, 1.0)) + shoulder
            joined = (person, side) in ((0, "left"), (1, "right"))
            grip = _held_hands(lead, follow, person, side, dance.hands)
            if joined:
                closed = grip + 0.22 * _rotated(lead["frame"], (1.0, 0.6, 0.0))
            else:
                closed = _hand_on_partner(bodies[1 - person], person)
            target = weight["open"][:, None] * grip + weight["closed"][:, None] * closed
            target = target + weight["one hand"][:, None] * (grip if joined else free)
            for turner in range(2):
                above = _raised_hands(bodies[turner], bodies[1 - turner], dance.heights[turner])
                goal = above if joined else free
                target = target + raised[turner][:, None] * (goal - target)
            back = shoulder - target
            target = target + _WRIST_TO_GRIP * back / np.linalg.norm(back, axis=-1, keepdims=True)
            lengths = (dance.heights[person] * _ARM[0], dance.heights[person] * _ARM[1])
            pole = _elbow_direction(frame, sign, target - shoulder)
            elbow, wrist = bent_limb(shoulder, target, lengths, pole)
            body |= {f"{side}_elbow": elbow, f"{side}_wrist": wrist}


def _held_hands(lead: Joints, follow: Joints, person: int, side: str, higher: float) -> np.ndarray:
    """Return the position of joined hands in an open hold, below the shoulders' midpoint."""
    opposite = "right" if side == "left" else "left"
    lead_side, follow_side = (side, opposite) if person == 0 else (opposite, side)
    middle = (lead[f"{lead_side}_shoulder"] + follow[f"{follow_side}_shoulder"]) / 2
    return middle - _UP * (0.28 - higher)


def _hand_on_partner(partner: Joints, person: int) -> np.ndarray:
    """Return the position of the free hand on the partner in a closed hold."""
    if person == 0:
        return partner["chest"] + _rotated(partner["frame"], (0.17, -0.02, 0.0))
    return partner["right_shoulder"] + _rotated(partner["frame"], (-0.03, -0.03, 0.05))


def _raised_hands(turner: Joints, partner: Joints, height: float) -> np.ndarray:
    """Return the position of raised hands: above the turning head, towards the partner."""
    towards = (partner["chest"] - turner["chest"]) * [1.0, 0.0, 1.0]
    above = turner["chest"] * [1.0, 0.0, 1.0] + 0.3 * towards
    return above + _UP * 1.01 * height


def _elbow_direction(frame: np.ndarray, sign: float, extent: np.ndarray) -> np.ndarray:
    """Return the direction of an elbow: backwards when the arm hangs, forwards when raised."""
    along = extent / np.linalg.norm(extent, axis=-1, keepdims=True)
    raised = rise((along * frame[..., 1]).sum(axis=-1) / 0.8)[:, None]
    low, high = _rotated(frame, (0.35 * sign, -1.0, -0.5)), _rotated(frame, (0.6 * sign, -0.2, 0.8))
    return (1 - raised) * low + raised * high


def _frame(yaw: np.ndarray, lean: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Return orientations (L, 3, 3) with columns left, up and forward."""
    return np.asarray(euler_to_matrix(np.stack([yaw, lean, roll], axis=-1), "YXZ"))


def _rotated(frames: np.ndarray, offset: Sequence[float] | np.ndarray) -> np.ndarray:
    """Rotate an offset by body orientations, ``(…, 3, 3), (3,) → (…, 3)``."""
    return np.asarray(frames @ np.asarray(offset))


def bent_limb(
    start: np.ndarray, target: np.ndarray, lengths: tuple[float, float], pole: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle joint and the end of a two-bone limb from ``start`` towards ``target``.

    Points are (…, 3), metres. The upper and the lower bone have exactly the given ``lengths``;
    ``pole`` is the direction of the elbow or knee; its component along the limb is ignored. The end
    lies on the line to the target; its distance from ``start`` is limited smoothly.
    """
    upper, lower = lengths
    longest = _MAX_EXTENSION * (upper + lower)
    shortest = np.sqrt(upper**2 + lower**2 - 2 * upper * lower * _MIN_ANGLE_COSINE)
    offset = target - start
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    along = offset / np.maximum(distance, 1e-9)
    reach = longest - _soft_positive(longest - distance)
    reach = shortest + _soft_positive(reach - shortest)
    bend = pole - (pole * along).sum(axis=-1, keepdims=True) * along
    bend = bend / np.maximum(np.linalg.norm(bend, axis=-1, keepdims=True), 1e-9)
    cosine = (upper**2 + reach**2 - lower**2) / (2 * upper * reach)
    middle = start + upper * (cosine * along + np.sqrt(1 - cosine**2) * bend)
    return middle, start + reach * along


def _soft_positive(x: np.ndarray) -> np.ndarray:
    """Return a smooth max(x, 0)."""
    return _SOFTNESS * np.logaddexp(x / _SOFTNESS, 0.0)
