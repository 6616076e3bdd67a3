from .cameras import Cameras as Cameras
from .rotations import (
    euler_to_matrix as euler_to_matrix,
    geodesic_angle as geodesic_angle,
    matrix_to_euler as matrix_to_euler,
    matrix_to_quaternion as matrix_to_quaternion,
    matrix_to_rotation_6d as matrix_to_rotation_6d,
    matrix_to_vector as matrix_to_vector,
    quaternion_product as quaternion_product,
    quaternion_to_matrix as quaternion_to_matrix,
    quaternion_to_vector as quaternion_to_vector,
    rotation_6d_to_matrix as rotation_6d_to_matrix,
    slerp as slerp,
    vector_to_matrix as vector_to_matrix,
    vector_to_quaternion as vector_to_quaternion,
)
from .triangulation import triangulate as triangulate
