from .articulated_body import ArticulatedBody as ArticulatedBody
from .body_states import (
    BodyStates as BodyStates,
    check_bones as check_bones,
    heading_of as heading_of,
    rest_pose as rest_pose,
    to_world as to_world,
    turned_about_vertical as turned_about_vertical,
)
