"""What commonly goes wrong with a checkout and its environment, and the mend: one finding a line.

Only the standard library is imported, for packages that are missing or broken are what this looks
for; MLflow, Rerun, torch and PyBullet are known by the files they are installed as.  So it runs
where the command `geodesics` does not start: `PYTHONPATH=src python3 -m
constraint_geodesics.doctor`.  A wrong Python must be able to say that it is one: the modules keep
to what Python 3.8 reads, with annotations that are never evaluated.
"""
