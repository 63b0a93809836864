"""What is given: finite MDPs without a reward, their graphs, and demonstrations in them (sections II and III)."""
