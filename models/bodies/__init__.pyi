from .articulated_body import ArticulatedBody as ArticulatedBody
from .body_states import (
    BodyStates as BodyStates,
    Placement as Placement,
    check_bones as check_bones,
    heading_of as heading_of,
    rest_pose as rest_pose,
    trunk_joints as trunk_joints,
    turned_about_vertical as turned_about_vertical,
)
from .joint_ranges import range_of as range_of
