from .cameras import Cameras as Cameras
from .rotations import (
    euler_to_matrix as euler_to_matrix,
)
from .rotations import (
    geodesic_angle as geodesic_angle,
)
from .rotations import (
    matrix_to_euler as matrix_to_euler,
)
from .rotations import (
    matrix_to_quaternion as matrix_to_quaternion,
)
from .rotations import (
    matrix_to_six_numbers as matrix_to_six_numbers,
)
from .rotations import (
    matrix_to_vector as matrix_to_vector,
)
from .rotations import (
    quaternion_product as quaternion_product,
)
from .rotations import (
    quaternion_to_matrix as quaternion_to_matrix,
)
from .rotations import (
    quaternion_to_vector as quaternion_to_vector,
)
from .rotations import (
    six_numbers_to_matrix as six_numbers_to_matrix,
)
from .rotations import (
    slerp as slerp,
)
from .rotations import (
    slerp_quaternions as slerp_quaternions,
)
from .rotations import (
    vector_to_matrix as vector_to_matrix,
)
from .rotations import (
    vector_to_quaternion as vector_to_quaternion,
)
from .triangulation import triangulate as triangulate
