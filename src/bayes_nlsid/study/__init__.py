"""Study files and case folders, the stage store, figures and the report."""
