"""Estimators: pure functions, each with a model or component that makes it a part."""
