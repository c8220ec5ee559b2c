"""Recordings to logs: one file a format, each with a source class that `conf/data/` names and that loads a data set."""
