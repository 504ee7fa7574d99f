// What a browser shows at an address where nothing is.

import { translatePage } from '../i18n/messages.js';

translatePage();
