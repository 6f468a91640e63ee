"""For people: tables, figures and reports."""
