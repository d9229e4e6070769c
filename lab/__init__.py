"""What proves rfedge: experiments, loads of several servers, city plans, recorded results."""
