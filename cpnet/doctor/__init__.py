"""`cpnet doctor`: what this machine lacks, what a bus elsewhere answers, what to do."""
