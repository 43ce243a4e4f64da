# SPDX-License-Identifier: Apache-2.0
"""The numbers of Tables I to VIII of Van Wyk, Falco and Cheok, as published."""

# Zero-offsets of joints 1 to 7, degrees: means, then standard deviations.
TABLE_I_DEG = {
    'mocap': (
        (0.477, -0.192, 0.139, 0.099, 0.392, -0.114, 0.936),
        (0.012, 0.010, 0.011, 0.013, 0.024, 0.016, 0.039),
    ),
    'tracker': (
        (0.408, -0.190, 0.130, 0.105, 0.378, -0.114, 1.262),
        (0.009, 0.009, 0.009, 0.013, 0.021, 0.017, 0.026),
    ),
}
# Corrections of the registration, means, then standard deviations: x, y, z in mm, then alpha,
# beta, gamma in degrees.
TABLE_II = {
    'mocap': (
        (-2.096, 0.502, 3.311, -0.252, -0.334, -0.960),
        (0.113, 0.114, 0.0748, 0.006, 0.005, 0.017),
    ),
    'tracker': (
        (2.240, -0.395, 7.325, -0.918, 0.099, 0.078),
        (0.039, 0.090, 0.088, 0.010, 0.005, 0.004),
    ),
}
# Standard deviation of a measured point, mm: its mean and its own standard deviation.
SIGMA_MM = {'mocap': (0.890, 0.027), 'tracker': (0.734, 0.025)}
# Mean and 95 % interval (low, high), mm, by table, sensor and side (before, after; in Table VIII
# relative, absolute).
ERRORS = {
    'III': {
        'mocap': ((3.384, 0.788, 6.513), (0.286, 0.007, 0.951)),
        'tracker': ((3.567, 0.673, 6.359), (0.264, 0.010, 0.800)),
    },
    'IV': {
        'mocap': ((4.715, 1.508, 8.581), (1.533, 0.459, 2.770)),
        'tracker': ((4.397, 1.517, 7.256), (1.213, 0.504, 2.128)),
    },
    'V': {
        'mocap': ((4.730, 1.353, 8.470), (1.433, 0.417, 2.750)),
        'tracker': ((4.410, 1.673, 7.737), (1.181, 0.344, 2.265)),
    },
    'VI': {
        'mocap': ((6.331, 2.041, 10.908), (1.439, 0.420, 2.758)),
        'tracker': ((5.676, 1.795, 10.191), (1.187, 0.345, 2.276)),
    },
    'VII': {
        'mocap': ((6.067, 1.918, 10.385), (0.223, 0.052, 0.512)),
        'tracker': ((5.575, 1.865, 9.681), (0.183, 0.042, 0.436)),
    },
    'VIII': {
        'mocap': ((0.558, 0.128, 1.21), (1.838, 0.794, 2.952)),
        'tracker': ((0.492, 0.113, 1.133), (1.509, 0.696, 2.556)),
    },
}
