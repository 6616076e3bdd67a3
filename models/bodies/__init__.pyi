from .articulated_body import ArticulatedBody as ArticulatedBody
from .body_states import (
    BodyStates as BodyStates,
)
from .body_states import (
    Placement as Placement,
)
from .body_states import (
    check_bones as check_bones,
)
from .body_states import (
    heading_of as heading_of,
)
from .body_states import (
    rest_pose as rest_pose,
)
from .body_states import (
    trunk_joints as trunk_joints,
)
from .body_states import (
    turned_about_vertical as turned_about_vertical,
)
from .joint_ranges import range_of as range_of
