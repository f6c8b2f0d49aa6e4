"""The Python interface: load, load_car, predict, diagnose, compare, check, drive, replay, learn, save_run.

``carlab`` re-exports these names. The command line calls this interface: each option of a verb is an argument of the
same name. The interface does not print. Each call imports the heavy libraries that it needs (torch, scipy, matplotlib,
rerun).
"""
