"""End-to-end simulation: rendered scenarios through the deployed loop; an ablation by stage."""
