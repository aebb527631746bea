"""Experiments with several trainings: the table of Janjoš et al. (2021), with ablations."""
