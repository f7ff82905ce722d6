MODULE TableTennis
    ! The arm's side of the bridge: EGM joint guidance with position and speed.
    !
    ! NOT TRIED ON HARDWARE. Written from public descriptions of ABB's EGM; docs/how-to/set-up-the-arm-controller.md
    ! explains every value and names its source. Try it in RobotStudio first.
    !
    ! Needs the option Externally Guided Motion, the entry TT_BRIDGE of transmission_protocol.txt and the entry
    ! table_tennis of MOC.cfg. Units: degrees, degrees per second, seconds; SampleRate in milliseconds.

    ! As delivered for commissioning: slow. Raise both with the bridge's speed_scale, as the page says: 600 times it, and
    ! a tenth more for position corrections. 66 fits 0.1, the speed_scale of a robot.yaml that gives none.
    CONST num max_speed_deviation := 66;
    CONST num max_position_deviation := 20;

    ! Below the bridge's own limits the arm stops by itself when replies stop. Test it: see the page.
    CONST num communication_timeout := 0.1;

    ! A joint this near to its reference, for convergence_time, would end EGM: as good as never.
    CONST egm_minmax convergence := [-0.5, 0.5];
    CONST num convergence_time := 3600;

    ! The TCP is the blade's far end, the fastest point, so that the 250 mm/s of manual reduced speed are kept there and
    ! not only at the flange. Measure it. Mass and centre of gravity: replace by what LoadIdentify measures.
    PERS tooldata paddle := [TRUE, [[0, 0, 326.3], [1, 0, 0, 0]], [0.5, [0, 0, 50], [1, 0, 0, 0], 0, 0, 0]];

    ! Set it to TRUE on the pendant to end guidance in an orderly way.
    PERS bool stop_guidance := FALSE;

    VAR egmident egm_id;
    VAR intnum stop_request;

    PROC main()
        stop_guidance := FALSE;
        IDelete stop_request;
        CONNECT stop_request WITH StopGuidance;
        IPers stop_guidance, stop_request;
        WHILE NOT stop_guidance DO
            GuideJoints;
            ! The bridge reports silence after 0.05 s; a pause makes the next session unmistakably a new one.
            WaitTime 1;
        ENDWHILE
        TPWrite "Table tennis: guidance has ended";
    ENDPROC

    PROC GuideJoints()
        VAR jointtarget here;
        ! An identity that an earlier run has left behind counts against the controller's few.
        EGMReset egm_id;
        EGMGetId egm_id;
        ! EGM begins at a fine point, and cannot be the first motion after a restart: a motion to where the arm stands.
        here := CJointT();
        MoveAbsJ here, v10, fine, paddle;
        EGMSetupUC ROB_1, egm_id, "table_tennis", "TT_BRIDGE" \Joint \CommTimeout:=communication_timeout;
        EGMActJoint egm_id \Tool:=paddle \WObj:=wobj0
            \J1:=convergence \J2:=convergence \J3:=convergence
            \J4:=convergence \J5:=convergence \J6:=convergence
            \LpFilter:=20 \SampleRate:=4
            \MaxPosDeviation:=max_position_deviation \MaxSpeedDeviation:=max_speed_deviation;
        ! Waits here while the bridge guides. HOLD: never RAMP_DOWN, which returns to where EGM began.
        EGMRunJoint egm_id, EGM_STOP_HOLD \J1 \J2 \J3 \J4 \J5 \J6
            \CondTime:=convergence_time \RampInTime:=1 \RampOutTime:=0.1 \PosCorrGain:=0.2;
        EGMReset egm_id;
    ERROR
        IF ERRNO = ERR_UDPUC_COMM THEN
            TPWrite "Table tennis: the bridge does not answer";
            EGMReset egm_id;
            RETURN;
        ENDIF
        ! Anything else stops the program: an operator has to look.
        RAISE;
    ENDPROC

    TRAP StopGuidance
        IF stop_guidance AND EGMGetState(egm_id) = EGM_STATE_RUNNING THEN
            EGMStop egm_id, EGM_STOP_HOLD \RampOutTime:=0.1;
        ENDIF
    ENDTRAP
ENDMODULE
