"""Files and pictures that a user keeps: report.json, model.json, report.html. No maths."""
