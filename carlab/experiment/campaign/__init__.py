"""The outer loop of learning: collect episodes, retrain the model, update the policy, drive again."""
