"""Policies of stable-baselines3 that are trained in the environments of `asp_env`.

`asp-env rl train` writes a run folder; `asp-env rl evaluate` drives held-out scenarios with it, and
`asp-env drive --planner sb3:RUN` compares it with other planners.
"""
