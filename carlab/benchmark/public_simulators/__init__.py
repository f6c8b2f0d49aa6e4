"""Study on a public simulator: diagnose cars of the package commonroad-vehicle-models."""
