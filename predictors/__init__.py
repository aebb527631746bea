"""Trajectory predictors: physical ones, networks, their training and their use."""
