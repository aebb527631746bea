"""The table of Janjoš et al. (2021) on other data, with ablations."""
