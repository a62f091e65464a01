"""What judges: errors and convergence, how far a filter knows when it is wrong, intervals and tests, networks.

``metrics`` one run after another; ``statistics`` intervals and tests by drive; ``trust`` how good ``p_lost`` is;
``run_table`` every run as a row; ``scores`` the drives of a log; ``quality`` one scan; ``tracking`` learned filters.
"""
