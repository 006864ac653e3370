"""The flight report: what a folder of products holds, in words, pictures and tables, as one page that needs nothing else."""
