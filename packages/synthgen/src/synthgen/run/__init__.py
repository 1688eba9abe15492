"""The applications behind the commands: jobs of any size on processes and clusters, with faults and estimates."""
