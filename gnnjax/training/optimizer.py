"""The optimizer of trainings: AdamW that warms up, decays by a cosine and clips gradients."""

import optax


def warmed_adamw(
    rate: float, num_steps: int, most_warmup: int, weight_decay: float = 1e-4
) -> optax.GradientTransformation:
    """AdamW for a run of so many updates.

    Args:
        rate: the peak, after the warm-up; at the last update it is zero.
        num_steps: updates of the run.
        most_warmup: updates of the warm-up, or a tenth of the run where that is less.
        weight_decay: of all weights.
    """
    warmup = min(most_warmup, num_steps // 10 + 1)
    decay = max(num_steps, warmup + 1)  # also for a run of one step
    schedule = optax.warmup_cosine_decay_schedule(0.0, rate, warmup, decay)
    return optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=weight_decay)
    )
