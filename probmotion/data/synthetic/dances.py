"""Procedural dances: two people in hold, who step, turn under raised arms and change holds.

They exist so that whatever is built for pose-pairs can be shown and tested on data that the project
makes itself. A dance is a row of figures of eight beats. The couple's centre, heading and distance
are smooth functions of time; feet are planted, beat by beat, where the hips will be; hands go
where the hold says. Bones keep their lengths, elbows and knees bend the natural way.
"""

from __future__ import annotations

import numpy as np

from probmotion import seeds
from probmotion.data.synthetic.choreography import HOLDS, Dance, draw_dance, level, rise
from probmotion.data.synthetic.limbs import bent_limb, rotated
from probmotion.geometry.rotations import euler_to_matrix
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive

__all__ = ["synthetic_dances"]

# Offsets from the parent in the body's frame (left, up, forward), shares of the height.
_SPINE, _CHEST, _NECK = (0.0, 0.10, 0.0), (0.0, 0.09, 0.0), (0.0, 0.10, -0.008)
_HEAD, _SHOULDER, _HIP = (0.0, 0.055, 0.022), (0.115, 0.075, -0.005), (0.057, 0.015, 0.0)
_ARM, _LEG, _ANKLE = (0.170, 0.146), (0.245, 0.246), 0.045
_SIDES = {"left": 1.0, "right": -1.0}
_UP = np.array([0.0, 1.0, 0.0])

_SWING = 0.8  # beats for which a foot is in the air
_WRIST_TO_GRIP = 0.05
Joints = dict[str, np.ndarray]
"""Positions (L, 3) by joint, and the chest's frame (L, 3, 3) as ``frame``."""


def synthetic_dances(
    n: int = 20, *, frames: int = 90, fps: float = 30.0, seed: int = 0
) -> list[Motion]:
    """Return ``n`` dances of two people on ``pair17``, named ``dance-0``, ``dance-1``, …

    ``person0`` leads and is about 1.7 m tall, ``person1`` about 1.6 m. Everything that varies from
    dance to dance (rhythm, figures, holds, steps, turns, posture) depends on ``seed`` and the
    number alone: a dance is the same however many are made.

    Parameters
    ----------
    n : int
        Number of dances.
    frames : int
        Frames of each; three seconds by default.
    fps : float
        Frames per second.
    seed : int
        Seed of what varies.
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
    """Return a person's joints (L, 3) without the arms, and the chest's frame (L, 3, 3)."""
    height, beats = dance.heights[person], dance.beats(time)
    mirror = 1.0 - 2.0 * person  # the follower's right foot goes with the leader's left
    root, yaw = dance.place(time, person)
    roll = mirror * 2.0 * dance.sway * np.sin(np.pi * beats)
    lean = dance.lean[person] + 0.04 * dance.wander(5 + person, time)
    twist = mirror * dance.twist * np.cos(np.pi * beats)
    still = np.zeros_like(time)
    pelvis = _frame(yaw - 0.5 * twist, lean, roll)
    spine = _frame(yaw, lean, still)
    chest = _frame(yaw + 0.5 * twist, lean + 0.02, -0.5 * roll)
    nod = 0.12 * dance.wander(7 + person, time)
    gaze = _frame(yaw + 0.2 * dance.wander(9 + person, time), lean + nod, still)
    stand = _ANKLE + sum(_LEG) * dance.bend[person] - _HIP[1]
    bob = 0.008 * np.cos(2 * np.pi * beats)
    joints = {"pelvis": root + _UP * (height * stand + bob)[:, None], "frame": chest}
    for name, parent, frame, offset in (
        ("spine", "pelvis", pelvis, _SPINE),
        ("chest", "spine", spine, _CHEST),
        ("neck", "chest", chest, _NECK),
        ("head", "neck", gaze, _HEAD),
    ):
        joints[name] = joints[parent] + height * rotated(frame, offset)
    for side, sign in _SIDES.items():
        own = (sign, 1.0, 1.0)
        joints[f"{side}_shoulder"] = joints["chest"] + height * rotated(
            chest, np.multiply(own, _SHOULDER)
        )
        hip = joints["pelvis"] + height * rotated(pelvis, np.multiply(own, _HIP))
        ankle = _foot(dance, person, sign, time)
        lengths = (height * _LEG[0], height * _LEG[1])
        knee, ankle = bent_limb(hip, ankle, lengths, rotated(pelvis, (0.15 * sign, 0.0, 1.0)))
        joints |= {f"{side}_hip": hip, f"{side}_knee": knee, f"{side}_ankle": ankle}
    return joints


def _foot(dance: Dance, person: int, sign: float, time: np.ndarray) -> np.ndarray:
    """Return where a foot's ankle (L, 3) should be: planted, or on its way to the next place."""
    height = dance.heights[person]
    odd = float((sign > 0) == (person == 0))  # every foot steps on every other beat
    beats = dance.beats(time)
    stepped = 2 * np.floor((beats - odd) / 2) + odd
    done = rise((beats - stepped) / _SWING)
    spots = []
    for step in (stepped - 2, stepped):
        # Under the hip in the middle of the stance.
        middle = (step + 1 + _SWING / 2 - dance.start) * dance.beat
        root, yaw = dance.place(middle, person)
        spots.append(root + (sign * (_HIP[0] + 0.01) * height) * level(yaw + np.pi / 2))
    move = spots[1] - spots[0]
    lift = np.minimum(0.03 + 0.15 * np.linalg.norm(move, axis=-1), 0.1)
    ankle = spots[0] + done[:, None] * move
    return ankle + _UP * (_ANKLE * height + lift * np.sin(np.pi * done) ** 2)[:, None]


def _join_hands(dance: Dance, bodies: list[Joints], time: np.ndarray) -> None:
    """Add elbows and wrists to both bodies: hands go where hold and turn say."""
    weights = dance.weights(time)
    shares = {
        hold: np.array([figure.hold == hold for figure in dance.figures]) @ weights
        for hold in HOLDS
    }
    raised = [dance.raised(time, person) for person in range(2)]
    lead, follow = bodies
    sides = {(0, "left"), (1, "right")}  # the hands that stay joined: leader's left
    for person, body in enumerate(bodies):
        for side, sign in _SIDES.items():
            shoulder = body[f"{side}_shoulder"]
            swing = 0.05 * np.sin(np.pi * dance.beats(time))
            free = rotated(body["frame"], (0.08 * sign, -0.34, 0.18)) + swing[:, None] * rotated(
                body["frame"], (0.0, 0.3, 1.0)
            )
            free += shoulder
            joined = (person, side) in sides
            grip = _grip(lead, follow, person, side, dance.hands)
            closed = (
                grip + 0.22 * rotated(lead["frame"], (1.0, 0.6, 0.0))
                if joined
                else _on_partner(bodies[1 - person], person)
            )
            target = shares["open"][:, None] * grip + shares["closed"][:, None] * closed
            target = target + shares["one hand"][:, None] * (grip if joined else free)
            for turner in range(2):
                above = _above(bodies[turner], bodies[1 - turner], dance.heights[turner])
                goal = above if joined else free
                target = target + raised[turner][:, None] * (goal - target)
            back = shoulder - target
            target = target + _WRIST_TO_GRIP * back / np.linalg.norm(back, axis=-1, keepdims=True)
            height = dance.heights[person]
            body[f"{side}_elbow"], body[f"{side}_wrist"] = bent_limb(
                shoulder,
                target,
                (height * _ARM[0], height * _ARM[1]),
                _elbow_points(body["frame"], sign, target - shoulder),
            )


def _grip(lead: Joints, follow: Joints, person: int, side: str, higher: float) -> np.ndarray:
    """Where hands of an open hold meet: between the shoulders, lower."""
    own, other = (side, "right" if side == "left" else "left")[:: 1 - 2 * person]
    between = (lead[f"{own}_shoulder"] + follow[f"{other}_shoulder"]) / 2
    return between - _UP * (0.28 - higher)


def _on_partner(partner: Joints, person: int) -> np.ndarray:
    """Where the other hand of a closed hold lies: her left side below the arm; his right arm."""
    if person == 0:
        return partner["chest"] + rotated(partner["frame"], (0.17, -0.02, 0.0))
    return partner["right_shoulder"] + rotated(partner["frame"], (-0.03, -0.03, 0.05))


def _above(turner: Joints, partner: Joints, height: float) -> np.ndarray:
    """Where the raised hands meet: above the head that turns, on the partner's side."""
    towards = (partner["chest"] - turner["chest"]) * [1.0, 0.0, 1.0]
    above = turner["chest"] * [1.0, 0.0, 1.0] + 0.3 * towards
    return above + _UP * 1.01 * height


def _elbow_points(frame: np.ndarray, sign: float, way: np.ndarray) -> np.ndarray:
    """Which way an elbow points: down, out and back; out and forward where the arm is raised."""
    along = way / np.linalg.norm(way, axis=-1, keepdims=True)
    raised = rise((along * frame[..., 1]).sum(axis=-1) / 0.8)[:, None]
    low, high = rotated(frame, (0.35 * sign, -1.0, -0.5)), rotated(frame, (0.6 * sign, -0.2, 0.8))
    return (1 - raised) * low + raised * high


def _frame(yaw: np.ndarray, lean: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Frames (L, 3, 3) whose columns are a body's left, up and forward."""
    return np.asarray(euler_to_matrix(np.stack([yaw, lean, roll], axis=-1), "YXZ"))
