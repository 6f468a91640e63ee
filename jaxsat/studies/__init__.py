"""Many trials: simulation and scores."""
