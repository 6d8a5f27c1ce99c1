"""From a model to a first config: what `headway init` writes.

The model's own numbers, and sound guesses where it has none. They follow from its dynamics: of each
joint the largest inertia M (others locked), the least m (others free) and the largest static load G
over the range, with known friction.

    effort limit         3 G + M a, a an acceleration that a drive of its kind is built for
    speed limit          half of what the effort reaches over the range
    acceleration limit   what the effort makes of m, and half as much again
    damping D            a share of M, less where the machine would be too fast to be sampled
    Kp                   D^2 / (4 zeta^2 M): damping ratio zeta at the largest inertia; more where
                         gravity would topple the joint
    motor                its back-EMF damps a third of D, and the supply covers both limits at once
    encoder              a count moves the servo's damping term by a few percent of the limit
    weights and noises   by the working effort U = G + M a and the acceleration U / M, so that the
                         problem looks alike on every axis; their size was found by trying
    task                 sines, slow and small enough for half of each effort limit
    horizon              twice what the task needs to stop
"""
