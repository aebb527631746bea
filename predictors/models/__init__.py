"""Networks: encoders, heads, losses and the predictors of the paper."""
