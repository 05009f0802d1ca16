"""What is claimed: tables, figures and pages, made from the store alone."""
