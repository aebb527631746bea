"""The table of Janjoš et al. (2021) on other data: which cells it has, their errors, its print."""
