"""Where the towers meet: alignment and the estimators, each with its parameters, state and step.

It does not read logs and does not loop over one.
"""
