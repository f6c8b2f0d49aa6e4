"""carlab's Sim-FSVGD: the posterior over functions around a simulator, and its distillation into particles."""
