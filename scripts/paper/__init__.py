"""The tables and figures of Dang & Suh 2014, run by `scripts/reproduce_paper.py`."""
