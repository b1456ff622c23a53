// Drawings of the icons, on 24 by 24 units, instead of the icon font, which is a third of a page's bytes. Runs before the page is built.
const LINE = "fill:none;stroke:currentColor;stroke-width:2;stroke-linecap:round;stroke-linejoin:round";
const FULL = "fill:currentColor", DOTS = "fill:none;stroke:currentColor;stroke-width:4;stroke-linecap:round";
const CIRCLE = "M12 3a9 9 0 1 0 0 18a9 9 0 1 0 0-18";
const ICONS = {
  add: ["M12 5v14M5 12h14"],
  arrow_drop_down: ["M6 9.5l6 6 6-6"],
  auto_fix_high: ["M4 20L15 9M17.5 3v4M15.5 5h4M19.5 10.5v4M17.5 12.5h4M9 3v4M7 5h4"],
  bookmark_add: ["M6 3.5h12v17l-6-4.5-6 4.5z"],
  brightness_auto: [`${CIRCLE}M12 3v18M12.5 6l5 2M12.5 11l7 1M12.5 16l6 1`],
  cancel: [`${CIRCLE}M9 9l6 6M15 9l-6 6`],
  check: ["M4 12.5l5.5 5.5L20 6"],
  chevron_left: ["M15 5l-7 7 7 7"],
  chevron_right: ["M9 5l7 7-7 7"],
  close: ["M6 6l12 12M18 6L6 18"],
  dark_mode: ["M20 14.5A8.5 8.5 0 1 1 9.5 4A7 7 0 0 0 20 14.5z"],
  download: ["M12 4v12M7.5 11.5L12 16l4.5-4.5M4 16v4h16v-4"],
  error: [`${CIRCLE}M12 7.5v5.5M12 16.5v.1`],
  expand_more: ["M5 9l7 7 7-7"],
  fact_check: ["M3 5h18v14H3zM6 9.5h5M6 14.5h5M13.5 12l2 2 3.5-4.5"],
  fiber_manual_record: ["M12 5a7 7 0 1 0 0 14a7 7 0 1 0 0-14", FULL],
  help: [`${CIRCLE}M9.3 9.5a2.7 2.7 0 1 1 2.7 2.8v1.4M12 17v.1`],
  history: ["M4.5 15a8 8 0 1 0 1-7.5M4.5 3.5v4.5h4.5M12 8v4.5l3 1.5"],
  info: [`${CIRCLE}M12 11v6M12 7.3v.1`],
  keyboard_arrow_down: ["M5 9l7 7 7-7"],
  keyboard_arrow_up: ["M5 15l7-7 7 7"],
  label: ["M3.5 6H15l5.5 6-5.5 6H3.5z"],
  light_mode: ["M12 8a4 4 0 1 0 0 8a4 4 0 1 0 0-8M12 2v2.5M12 19.5V22M2 12h2.5M19.5 12H22M5 5l1.7 1.7M17.3 17.3L19 19M19 5l-1.7 1.7M6.7 17.3L5 19"],
  lock: ["M6 11h12v9.5H6zM8.5 11V7.5a3.5 3.5 0 0 1 7 0V11"],
  masks: ["M3 8c6-2 12-2 18 0v3a6 6 0 0 1-9 4a6 6 0 0 1-9-4zM7.5 11h1.5M15 11h1.5"],
  memory: ["M7 7h10v10H7zM10 3v4M14 3v4M10 17v4M14 17v4M3 10h4M3 14h4M17 10h4M17 14h4"],
  more_vert: ["M12 5v.1M12 12v.1M12 19v.1", DOTS],
  play_arrow: ["M7 4.5L19.5 12 7 19.5z", FULL],
  playlist_add: ["M4 6h11M4 11h11M4 16h6M17 13v7M13.5 16.5h7"],
  schedule: [`${CIRCLE}M12 7v5l3.5 2`],
  search: ["M10.5 4a6.5 6.5 0 1 0 0 13a6.5 6.5 0 1 0 0-13M15.5 15.5L21 21"],
  stop: ["M6 6h12v12H6z", FULL],
  table_rows: ["M4 5h16v14H4zM4 9.7h16M4 14.3h16"],
  terminal: ["M3 4.5h18v15H3zM7 9.5l3 2.5-3 2.5M12.5 15H17"],
  thumb_down: ["M7.5 4H17l3 8v2.5h-6l1 5.5-1.5 1L7.5 14zM3.5 4v10"],
  tune: ["M4 7h8M16 7h4M14 5v4M4 12h2M10 12h10M8 10v4M4 17h10M18 17h2M16 15v4"],
  undo: ["M8 5L3.5 9.5 8 14M4 9.5h11a5 5 0 0 1 0 10h-5"],
  upload_file: ["M12 16V5M7.5 9.5L12 5l4.5 4.5M4 15v5h16v-5"],
};
vue_config.iconMapFn = (name) => {
  if (!ICONS[name]) return undefined;
  const [path, style = LINE] = ICONS[name];
  return { icon: `${path}@@${style}` };
};
