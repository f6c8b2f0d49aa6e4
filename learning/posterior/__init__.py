"""carlab's own method: the posterior over functions around a simulator, and its distillation into particles."""
