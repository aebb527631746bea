"""The closed loop: worlds that step many episodes at once, drivers, observations, rewards."""
