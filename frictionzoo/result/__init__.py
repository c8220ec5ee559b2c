"""What a run found, and how it is judged: rollouts against recordings, and the record `result.json`."""
