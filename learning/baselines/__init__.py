"""Baselines: deep ensemble, ridge regression, SysID and GreyBox."""
