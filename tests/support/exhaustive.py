"""Tests, or single parameters of them, that `make test` leaves out and `make test-exhaustive` runs.

They repeat what shorter ones test with more pages, languages, chips, compilers, kills or trainings. Tests that
docs/security.md names are not among them.
"""

EXHAUSTIVE = {
    "bench/test_peers.py::test_a_peer_that_is_not_installed_is_named_with_how_to_get_it",
    "bench/test_peers.py::test_without_any_peer_ours_and_plain_loops_are_measured_with_both_algorithms",
    "cli/test_kill.py::test_kill_9_in_the_middle",
    "cli/test_paper_page.py::test_every_command_runs",
    "cli/test_paper_page.py::test_the_tutorial_ends_with_the_same_answers_in_c",
    "cli/test_profile.py::test_how_it_is_compiled_matters",
    "cli/test_publish.py::test_saving_and_leaving_the_report_out",
    "deploy/proof/test_device.py::test_a_chip_of_qemu_answers_over_its_uart[cortex-m4-tcp]",
    "deploy/proof/test_device.py::test_a_chip_of_qemu_answers_over_its_uart[riscv32-pty]",
    "deploy/proof/test_verify.py::test_a_fault_of_the_rules_that_no_scenario_shows_is_no_defect_of_the_c",
    "deploy/proof/test_verify.py::test_every_fault_is_caught_on_the_host[all]",
    "deploy/proof/test_verify.py::test_every_fault_of_a_vector_layer_is_caught",
    "deploy/proof/test_verify.py::test_every_way_to_compile_on_the_host",
    "deploy/proof/test_verify.py::test_the_same_on_every_chip[four-layers-6]",
    "deploy/proof/test_verify.py::test_the_same_on_every_chip[one-layer-8]",
    "deploy/proof/test_verify.py::test_the_same_on_every_chip[paper-11]",
    "deploy/proof/test_verify.py::test_the_same_on_every_chip[two-layers-3]",
    "deploy/proof/test_verify.py::test_the_same_on_every_chip[vectors-3]",
    "deploy/proof/test_verify.py::test_the_same_on_every_chip[vectors-6]",
    "deploy/proof/test_verify.py::test_without_smoothing_no_mutant_is_applied_that_cannot_show",
    "deploy/test_c_image.py::test_sanitizers_find_nothing_in_window_networks",
    "deploy/test_c_source.py::test_clang_tidy",
    "deploy/test_c_source.py::test_no_warning_and_three_functions_of_the_c_library[plain-clang]",
    "deploy/test_c_source.py::test_no_warning_and_three_functions_of_the_c_library[window-clang]",
    "deploy/test_c_window.py::test_mutants_of_the_window_are_caught",
    "deploy/test_firmware.py::test_clang_agrees",
    "deploy/test_profile.py::test_a_larger_network_costs_more_only_where_it_is_larger",
    "deploy/test_profile.py::test_counts[cortex-m33]",
    "deploy/test_profile.py::test_counts[cortex-m4]",
    "deploy/test_profile.py::test_counts[riscv32]",
    "deploy/test_profile.py::test_the_networks_of_the_issue_stay_within_their_limits[14d1_19d2_19d4-limits1]",
    "deploy/test_profile.py::test_the_networks_of_the_issue_stay_within_their_limits[14d1_39d2_41d4-limits0]",
    "experiments/people/test_explanation.py::test_a_network_that_reads_one_channel_at_one_moment_is_explained_by_it",
    "experiments/search/test_run.py::test_killed_in_every_rung_and_gone_on_with",
    "experiments/sweep/test_cluster.py::test_a_cluster_that_is_not_there[127.0.0.1:1]",
    "experiments/sweep/test_cluster.py::test_a_cluster_that_is_not_there[nowhere.invalid:6379]",
    "experiments/sweep/test_cluster.py::test_a_node_lost_in_a_sweep_changes_nothing",
    "experiments/sweep/test_run.py::test_killed_three_times_and_gone_on_with",
    "jobs/test_cluster.py::test_what_a_job_raises_comes_through",
    "recording/test_whole_session.py::test_killed_three_times",
    "studio/test_export_page.py::test_export_verify_and_break",
    "studio/test_live_long.py::test_every_gesture_is_seen_with_its_affect_and_nothing_grows",
    "studio/test_live_page.py::test_a_hard_case_is_kept_labelled_and_in_the_data_set",
    "studio/test_live_page.py::test_a_new_person_is_led_through_the_validation",
    "studio/test_live_page.py::test_a_toy_that_goes_away_and_comes_back",
    "studio/test_live_page.py::test_a_toy_that_goes_away_while_the_page_is_behind",
    "studio/test_live_page.py::test_an_event_is_marked_as_wrong_and_the_network_improved",
    "studio/test_live_page.py::test_another_bundle_while_it_runs_and_one_that_does_not_fit",
    "studio/test_live_page.py::test_it_reads_well_in_any_light_and_language[en-dark-desk]",
    "studio/test_live_page.py::test_it_reads_well_in_any_light_and_language[lv-dark-tablet]",
    "studio/test_live_page.py::test_the_server_is_killed_while_a_clip_is_recorded",
    "studio/test_pictures_of_pages.py::test_a_page_reads_well[export-desk-light-en]",
    "studio/test_pictures_of_pages.py::test_a_page_reads_well[live-desk-light-en]",
    "studio/test_pictures_of_pages.py::test_a_page_reads_well[record-desk-light-en]",
    "studio/test_publish_page.py::test_publish_check_and_break",
    "studio/test_record.py::test_a_studio_that_is_gone_is_not_shown_as_recording",
    "studio/test_record.py::test_every_page_names_the_session_that_is_being_recorded",
    "studio/test_record.py::test_it_speaks_latvian_and_fits_a_phone",
    "studio/test_record.py::test_one_press_is_one_command",
    "studio/test_record.py::test_two_tabs_show_and_press_the_same_once",
    "studio/test_record_refusals.py::test_a_toy_that_goes_away_and_comes_back",
    "studio/test_record_whole.py::test_a_whole_session_by_the_space_bar",
    "studio/test_review.py::test_a_click_moves_the_mark_to_within_a_sample[size1]",
    "studio/test_review.py::test_a_click_moves_the_mark_to_within_a_sample[size2]",
    "studio/test_review.py::test_durations_with_an_adjustable_band",
    "studio/test_review.py::test_one_recording_has_no_violation_in_any_light",
    "studio/test_review.py::test_overlays_name_what_stands_out",
    "studio/test_review.py::test_real_recordings_one_after_the_other",
    "studio/test_review.py::test_two_tabs_show_the_same_and_do_not_fight",
    "studio/test_shell.py::test_pages_open_without_complaint[en-light-desk]",
    "studio/test_shell.py::test_the_bar_is_one_row_on_a_tablet",
    "studio/test_train.py::test_a_proof_its_table_and_the_recordings_of_a_cell",
    "studio/test_train.py::test_a_sweep_shows_its_cost_first_and_its_front_in_the_end",
    "studio/test_train.py::test_a_training_is_stopped_and_killed_and_ends_in_the_commands_bundle",
    "studio/test_train.py::test_one_button_makes_a_network_that_a_stop_does_not_lose",
    "test_questions.py::test_every_program_runs",
    "workflow/test_estimator.py::test_labels_keep_their_type[case]",
    "workflow/test_estimator.py::test_labels_keep_their_type[int]",
    "workflow/test_forget_beside.py::test_who_is_forgotten_meanwhile_does_not_come_back[baselines-late]",
    "workflow/test_paper.py::test_the_papers_result_with_pca_stands_beside_pca_without_scaling",
    *(
        f"deploy/proof/test_verify.py::test_faults_are_caught_on_every_chip[{chip}]"
        for chip in ("cortex-m0", "cortex-m33", "cortex-m4", "riscv32")
    ),
    *(
        f"deploy/test_c_source.py::test_small_cores_need_no_long_division[{form}]"
        for form in ("stream-cortex-m4", "window-cortex-m4", "stream-lx106")
    ),
    *(
        f"faults/test_interrupted.py::test_given_again_it_does_what_it_does_undisturbed[{command}-full-0]"
        for command in ("adapt", "backup", "check", "export", "forget")
    ),
    *(
        f"tuning/test_gate.py::test_neither_humidity_nor_the_hand_matters_much[{form}]"
        for form in ("damp skin", "small hands", "the same day")
    ),
    *(
        f"workflow/test_forget_beside.py::test_who_is_forgotten_meanwhile_does_not_come_back[{command}-early]"
        for command in ("abstaining", "baselines", "evaluate_in_processes", "search", "streams", "sweep")
    ),
    *(
        f"studio/test_pictures_of_pages.py::test_a_page_reads_well[{page}-{view}]"
        for page in ("home", "record", "review", "train", "live", "export", "publish")
        for view in ("wide-dark-en", "tablet-light-lv")
    ),
    *(
        f"studio/test_pictures_of_pages.py::test_a_page_reads_well[{page}-phone-dark-lv]"
        for page in ("home", "record", "review", "train", "live", "export", "publish")
    ),
    *(
        f"test_pages.py::test_every_command_of_the_page_runs[docs/{page}.md]"
        for page in (
            "baselines",
            "checks",
            "commands",
            "firmware",
            "importing",
            "live",
            "network-search",
            "pairing",
            "people",
            "personal",
            "questions",
            "results",
            "streams",
            "sweep",
            "trim",
            "virtual-toy",
        )
    ),
}
