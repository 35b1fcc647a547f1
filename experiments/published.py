"""What others state, and at the end what this project's history holds; nothing here was measured by
the present code."""

# Diao, Chi and Wang, "Graph Neural Network Based Method for Path Planning Problem", in words; its
# figures have no tables. Figure 5 (R^7), over all roadmap sizes.
FIGURE5 = {
    "gnn": {"success": 0.98, "cost": 19.452, "total_time_s": 1.63, "planning_time_s": 0.193},
    "prm": {"success": 0.97, "cost": 13.473, "total_time_s": 20.47, "planning_time_s": 12.02},
    "ompl:bit_star": {"success": 0.97, "cost": 12.271},
    "ompl:rrt_star": {"success": 0.98, "cost": 16.010},
}
# Edge checks of its planner as shares of those of others, and its success on large roadmaps.
FIGURE5_CHECK_SHARES = {"prm": 0.0049, "ompl:bit_star": 0.9443, "ompl:rrt_star": 0.0174}
FIGURE5_SUCCESS_AT_1000 = 0.99
# Figure 7 (R^6): what its planner saves, as a share of the other's.
FIGURE7 = {
    "edge_checks": {"than": "prm", "saved": 0.997},
    "planning_time_s": {"than": "ompl:bit_star", "saved": 0.986},
}
# Its ten problems with a real arm: paths found, and those of them that suited it; BIT*'s beside.
REAL_ARM = {
    "gnn": {"found": 0.8, "suitable": 0.6},
    "ompl:bit_star": {"found": 0.9, "suitable": 0.8},
}

# What a configuration check of others costs, s: orders of magnitude to read an axis by, which no
# text quotes.
CHECK_S = {"PyBullet": 80e-6, "a simulator": 1e-2}

# VAMP (Thomason, Kingston and Kavraki, "Motions in Microseconds via Vectorized Sampling-Based
# Planning"): its mean time of a plan, s, by its authors' own account. RRT-Connect in C++ with SIMD
# and spheres, 699 of MotionBenchMaker's problems of the Panda: another machine, other problems.
VAMP_PLAN_S = {"first path": 76e-6, "simplified": 144e-6}

# The campaigns against the certificate, when it bounded motions by reach alone: the sums of
# results/certify_campaign.json and certify_curves.json in this project's commits "A million
# certified edges: none refuted" and "104,231 pieces of rounded paths before MuJoCo's C engine: none
# refuted".
BY_REACH_ALONE = {"edges": 1_000_008, "pieces": 104_231, "refuted": 0}
