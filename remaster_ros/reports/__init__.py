"""fit.json and discovery.json, figures and pages."""
