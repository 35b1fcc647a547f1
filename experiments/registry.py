"""All experiments; a new one is a module and an entry here."""

from experiments import (
    ablation,
    arms,
    calibrate_field,
    converged,
    crossover,
    failures,
    figure5,
    figure7,
    guides,
    hard,
    inverse_kinematics,
    motion_bench_maker,
    motions,
    predictor,
    real_arm,
    throughput,
)
from experiments.record import Experiment

# In the order in which they share runs: crossover, hard and failures read those of figure5.
EXPERIMENTS: dict[str, Experiment] = {
    module.EXPERIMENT.name: module.EXPERIMENT
    for module in (
        figure5,
        figure7,
        crossover,
        hard,
        failures,
        arms,
        predictor,
        guides,
        calibrate_field,
        ablation,
        converged,
        throughput,
        motion_bench_maker,
        motions,
        real_arm,
        inverse_kinematics,
    )
}
