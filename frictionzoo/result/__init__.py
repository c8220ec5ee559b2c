"""Results of a run and their evaluation: rollouts compared with recordings, and `result.json`."""
