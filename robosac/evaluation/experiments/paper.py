"""Numbers of the paper (*Among Us*, ICCV 2023), to stand beside ours."""

from __future__ import annotations

# eta, s, N of Eq. 2, mean steps, success rate
TABLE_1 = (
    (0.2, 1, 3, 1.32, 0.96),
    (0.2, 2, 5, 1.76, 0.97),
    (0.2, 3, 7, 2.31, 1.00),
    (0.2, 4, 9, 4.89, 0.89),
    (0.4, 1, 6, 1.80, 0.98),
    (0.4, 2, 11, 3.06, 1.00),
    (0.4, 3, 19, 10.36, 0.86),
    (0.6, 1, 10, 2.46, 1.00),
    (0.6, 2, 27, 8.29, 0.97),
    (0.8, 1, 21, 4.73, 1.00),
)

# AP50, AP70 (per cent), success rate
BUDGETS = {
    "all benign": (81.3, 79.8, None),
    "3 benign": (78.0, 76.0, None),
    "Algorithm 1, N = 7": (77.3, 74.7, 1.00),
    "Algorithm 1, N = 5": (76.6, 74.1, 0.96),
    "Algorithm 1, N = 3": (74.8, 73.2, 0.77),
    "Algorithm 1, N = 1": (69.8, 67.4, 0.45),
    "ego only": (63.5, 60.1, None),
    "no defence": (39.7, 39.0, None),
}

# AP50, AP70, mean steps or success, FPS (computed from constants in the paper, not measured)
DYNAMIC = (77.5, 74.9, 2.73, 14.2)
STATIC = (78.8, 76.5, 2.30, 36.8)
TEMPORAL = (75.8, 73.6, 0.85, 19.2)

# AP50, AP70 of the defence and of the detector trained against PGD
GENERALISATION = {"pgd": ((77.3, 74.7), (75.6, 73.0)), "cw": ((74.5, 71.1), (43.2, 40.8))}

# attackers of five: mean total steps, mean estimate
RATIO_ESTIMATION = ((1, 0.0), (8.2, 0.22), (20.5, 0.42), (37.9, 0.60), (59, 0.80), (77, 1.0))
